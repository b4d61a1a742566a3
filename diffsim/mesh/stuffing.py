"""Tetrahedra that follow a surface: isosurface stuffing on a body-centered cubic lattice.

Labelle, Shewchuk 2007, "Isosurface Stuffing: Fast Tetrahedral Meshes with Good Dihedral Angles".
Lattice nodes that lie too close to the surface are moved onto it, the lattice's tetrahedra are then
cut at the surface, and neighbors cut their common face along the same diagonal. Uniform lattice;
edges and corners sharper than the spacing are cut off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
import torch

from diffsim.core.arrays import Array, IntArray
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.mesh.box import grid_hexes
from diffsim.mesh.core import TetMesh
from diffsim.mesh.hinges import without_hinges
from diffsim.mesh.reference import TET_EDGES
from diffsim.mesh.repair import remove_unreferenced_nodes
from diffsim.mesh.voxels import evaluate, grid

ALPHA_LONG, ALPHA_SHORT = 0.24999, 0.41189
"""A node moves to a cut nearer than this part of a long or short edge (paper, table 1)."""

_INSIDE, _ON, _OUTSIDE = -1, 0, 1


@checked
def tet_from_sdf(
    sdf: Callable[[Any], Any],
    bounds: Sequence[Sequence[float]],
    spacing: float,
    keep: str = "largest",
) -> TetMesh:
    """Tetrahedra that fill a solid, with the nodes of their boundary on its surface.

    Args:
        sdf: Signed distance (N, 3) -> (N,) [m], negative inside; on torch tensors or NumPy arrays.
            Only its zero and signs matter; details finer than ``spacing`` are lost.
        bounds: Lower and upper corner of a box that holds the whole solid [m].
        spacing: Longest edge of an interior tetrahedron [m]; the other edges have 0.87 of it.
        keep: "largest": only the largest part that hangs together through faces; "all". Elements
            that hang on by a mere edge or node are dropped either way.

    Returns:
        Mesh with dihedral angles between about 10 and 165 degrees for smooth surfaces.

    Raises:
        MeshError: nothing is inside, or the solid reaches beyond the bounds.
    """
    require_choice("keep", keep, ["largest", "all"])
    return fill(sdf, bounds, spacing, keep)


def fill(
    sdf: Callable[[Any], Any],
    bounds: Sequence[Sequence[float]],
    spacing: float,
    keep: str,
    inside: Callable[[Array, IntArray], np.ndarray] | None = None,
) -> TetMesh:
    """`tet_from_sdf`, where a faster test than the distance may tell what is inside.

    ``inside(first, counts)`` takes point (0, 0, 0) and the number of points (3,) of a grid with
    the lattice's spacing and returns (nx, ny, nz) bool.
    """
    lattice = _lattice(sdf, bounds, spacing, inside)
    cuts = _cut_edges(sdf, lattice)
    _warp(lattice, cuts)
    tets = _stuff(lattice, cuts)
    tets = without_hinges(tets, keep == "largest")
    x = torch.from_numpy(np.concatenate([lattice.x, cuts.x]))
    return TetMesh(*remove_unreferenced_nodes(x, torch.from_numpy(tets)))


@dataclass
class _Lattice:
    """Nodes near the solid and the tetrahedra that touch its inside."""

    x: Array  # places of the nodes, (V, 3) [m]
    side: IntArray  # (V,) inside, on, outside
    center: np.ndarray  # (V,) bool: center of a cube rather than corner; long edges join equals
    tets: IntArray  # (T, 4)


@dataclass
class _Cuts:
    """Edges that cross the surface; cut ``c`` becomes node ``num_lattice_nodes + c``."""

    edges: IntArray  # (C, 2) inside node, outside node
    t: Array  # (C,) place of the cut from the inside node [-]
    x: Array  # places of the cuts, (C, 3) [m]
    keys: IntArray  # (C,) ascending, of the sorted edge
    num_nodes: int

    def node(self, a: IntArray, b: IntArray) -> IntArray:
        """Node of the cut on the edges a-b."""
        key = np.minimum(a, b) * self.num_nodes + np.maximum(a, b)
        return self.num_nodes + np.searchsorted(self.keys, key)


def _lattice(
    sdf: Callable[[Any], Any],
    bounds: Sequence[Sequence[float]],
    spacing: float,
    inside_grid: Callable[[Array, IntArray], np.ndarray] | None,
) -> _Lattice:
    low, cells = grid(bounds, spacing)
    low, cells = low - 1.5 * spacing, cells + 3  # a margin that must be outside
    corner = np.indices((cells + 1).tolist()).reshape(3, -1).T.astype(np.float64)
    middle = np.indices(cells.tolist()).reshape(3, -1).T + 0.5
    x = low + spacing * np.concatenate([corner, middle])
    num_corners = len(corner)
    if inside_grid is None:
        side = np.sign(evaluate(sdf, x)).astype(np.int64)
    else:
        parts = [inside_grid(low, cells + 1), inside_grid(low + 0.5 * spacing, cells)]
        side = np.where(np.concatenate([part.reshape(-1) for part in parts]), _INSIDE, _OUTSIDE)
    inside = side == _INSIDE
    if not inside.any():
        raise MeshError(
            f"no lattice node lies inside; make spacing smaller than {spacing:g} m, check bounds, "
            "and that the distance is negative inside"
        )
    rim = np.concatenate([((corner == 0) | (corner == cells)).any(axis=1), np.zeros(len(middle))])
    if (inside & (rim > 0)).any():
        raise MeshError(
            "the solid reaches beyond the bounds; widen them, or cut it with "
            "sdf.intersection(shape, sdf.box(...))"
        )
    # one octahedron around each face that two cells share: four tetrahedra around the axis
    tets = []
    strides = np.array([cells[1] * cells[2], cells[2], 1])
    ring = np.array([[4, 6, 7, 5], [2, 3, 7, 6], [1, 5, 7, 3]])  # faces +i, +j, +k from outside
    for c in range(3):
        shape = cells.tolist()
        shape[c] -= 1
        ijk = np.indices(shape).reshape(3, -1).T
        first = num_corners + ijk @ strides
        around = grid_hexes(ijk, cells.tolist())[:, ring[c]]
        touched = inside[first] | inside[first + strides[c]] | inside[around].any(axis=1)
        first, around = first[touched], around[touched]
        for s in range(4):
            a, b = around[:, s], around[:, (s + 1) % 4]
            tets.append(np.stack([first, a, b, first + strides[c]], axis=1))
    all_tets = np.concatenate(tets)
    all_tets = all_tets[inside[all_tets].any(axis=1)]
    used, local = np.unique(all_tets, return_inverse=True)
    return _Lattice(x[used], side[used], used >= num_corners, local.reshape(-1, 4))


def _cut_edges(sdf: Callable[[Any], Any], lattice: _Lattice) -> _Cuts:
    """Edges with one end inside and one outside, and where the surface crosses them."""
    num = len(lattice.x)
    pairs = np.sort(lattice.tets[:, TET_EDGES].reshape(-1, 2), axis=1)
    crossing = lattice.side[pairs[:, 0]] * lattice.side[pairs[:, 1]] < 0
    keys = np.unique(pairs[crossing, 0] * num + pairs[crossing, 1])
    edges = np.stack([keys // num, keys % num], axis=1)
    swap = lattice.side[edges[:, 0]] == _OUTSIDE
    edges[swap] = edges[swap][:, ::-1]
    start, end = lattice.x[edges[:, 0]], lattice.x[edges[:, 1]]
    t = _crossing(
        lambda at, rows: evaluate(sdf, start[rows] + at * (end - start)[rows]), len(edges)
    )
    return _Cuts(edges, t, start + t[:, None] * (end - start), keys, num)


def _crossing(f: Callable[[Array, IntArray], Array], num: int) -> Array:
    """Zeros of ``num`` functions on [0, 1], negative at 0 and positive at 1, by regula falsi.

    The end that stays halves its value (Illinois); stops at 1e-9 or after 12 rounds.
    """
    rows = np.arange(num)
    a, b = np.zeros(num), np.ones(num)
    fa = np.minimum(f(a[:, None], rows), -1e-300)
    fb = np.maximum(f(b[:, None], rows), 1e-300)
    t = a - fa / (fb - fa)
    last = np.zeros(num)
    for _ in range(12):
        at = t[rows]
        value = f(at[:, None], rows)
        left = value < 0
        fb[rows] = np.where(left, np.where(last[rows] < 0, 0.5, 1.0) * fb[rows], value)
        fa[rows] = np.where(left, value, np.where(last[rows] > 0, 0.5, 1.0) * fa[rows])
        a[rows], b[rows] = np.where(left, at, a[rows]), np.where(left, b[rows], at)
        last[rows] = np.where(left, -1.0, 1.0)
        rise = np.maximum(fb[rows] - fa[rows], 1e-300)
        t[rows] = np.clip(a[rows] - (b - a)[rows] * fa[rows] / rise, a[rows], b[rows])
        rows = rows[np.abs(t[rows] - at) > 1e-9]
        if len(rows) == 0:
            break
    return t


def _warp(lattice: _Lattice, cuts: _Cuts) -> None:
    """Move nodes that a cut comes too near to onto the surface, no two ends of an edge at once."""
    long_edge = lattice.center[cuts.edges[:, 0]] == lattice.center[cuts.edges[:, 1]]
    alpha = np.where(long_edge, ALPHA_LONG, ALPHA_SHORT)
    ends = cuts.edges.reshape(-1)  # inside end, outside end of each cut in turn
    distance = np.stack([cuts.t, 1.0 - cuts.t], axis=1) / alpha[:, None]
    distance = distance.reshape(-1)
    cut_idx = np.repeat(np.arange(len(cuts.edges)), 2)
    while True:
        alive = (lattice.side[cuts.edges] != _ON).all(axis=1)
        near = np.flatnonzero(alive[cut_idx] & (distance < 1.0))
        if len(near) == 0:
            return
        near = near[np.argsort(distance[near], kind="stable")]
        nodes, first = np.unique(ends[near], return_index=True)  # the nearest cut of each node
        priority = np.full(len(lattice.x), np.inf)
        priority[nodes] = first  # ranks differ: of two neighbors the nearer one moves
        rival = np.full(len(lattice.x), np.inf)
        live = cuts.edges[alive]
        np.minimum.at(rival, live[:, 0], priority[live[:, 1]])
        np.minimum.at(rival, live[:, 1], priority[live[:, 0]])
        moves = priority[nodes] < rival[nodes]
        chosen = near[first[moves]]
        lattice.x[nodes[moves]] = cuts.x[cut_idx[chosen]]
        lattice.side[nodes[moves]] = _ON


def _stuff(lattice: _Lattice, cuts: _Cuts) -> IntArray:
    """The part of every tetrahedron that is inside, as tetrahedra."""
    tets = _sorted_by_side(lattice.tets, lattice.side)
    side = lattice.side[tets]
    num_in, num_out = (side == _INSIDE).sum(axis=1), (side == _OUTSIDE).sum(axis=1)
    out = [tets[(num_in > 0) & (num_out == 0)]]

    one = tets[(num_in == 1) & (num_out > 0)].copy()
    for c in range(1, 4):
        outside = lattice.side[one[:, c]] == _OUTSIDE
        one[outside, c] = cuts.node(one[outside, 0], one[outside, c])
    out.append(one)

    p, q, z, n = tets[(num_in == 2) & (num_out == 1)].T
    cut_p, cut_q = cuts.node(p, n), cuts.node(q, n)
    from_p = _diagonal_from_first(lattice, p, q, n)
    second = np.where(from_p, cut_q, cut_p)
    out.append(np.stack([p, q, z, second], axis=1))
    out.append(np.stack([np.where(from_p, p, q), cut_q, z, cut_p], axis=1))

    a = tets[(num_in == 3) & (num_out == 1)]
    n = a[:, 3]
    b = np.stack([cuts.node(a[:, c], n) for c in range(3)], axis=1)
    bits = [_diagonal_from_first(lattice, a[:, c], a[:, (c + 1) % 3], n) for c in range(3)]
    out.append(_prisms(a[:, :3], b, np.stack(bits, axis=1)))

    p, q, m, n = tets[(num_in == 2) & (num_out == 2)].T
    a = np.stack([p, cuts.node(p, m), cuts.node(p, n)], axis=1)
    b = np.stack([q, cuts.node(q, m), cuts.node(q, n)], axis=1)
    on_m = _diagonal_from_first(lattice, p, q, m)
    on_n = ~_diagonal_from_first(lattice, p, q, n)
    x = np.concatenate([lattice.x, cuts.x])
    shorter = _length(x, a[:, 1], b[:, 2]) < _length(x, a[:, 2], b[:, 1])
    free = np.where(on_m == on_n, ~on_m, shorter)  # equal bits all around make no tetrahedra
    out.append(_prisms(a, b, np.stack([on_m, free, on_n], axis=1)))
    return np.concatenate(out)


def _sorted_by_side(tets: IntArray, side: IntArray) -> IntArray:
    """Renumber each tetrahedron inside < on < outside without turning it inside out."""
    order = np.argsort(side[tets], axis=1, kind="stable")
    odd = np.zeros(len(tets), bool)
    for i in range(4):
        for j in range(i + 1, 4):
            odd ^= order[:, i] > order[:, j]
    out = np.take_along_axis(tets, order, axis=1)
    sides = side[out]
    done = ~odd
    for c in range(3):  # two of four nodes are on the same side: swap these
        swap = ~done & (sides[:, c] == sides[:, c + 1])
        out[swap, c], out[swap, c + 1] = out[swap, c + 1], out[swap, c]
        done |= swap
    return out


def _diagonal_from_first(lattice: _Lattice, p: IntArray, q: IntArray, n: IntArray) -> np.ndarray:
    """Of the quad p, q, cut(q, n), cut(p, n): is its diagonal p - cut(q, n)?

    It ends at the cut of the long edge; where both cut edges are short, at the lower node.
    """
    center = lattice.center
    return np.where(center[p] == center[q], p < q, center[q] == center[n])


def _prism_table() -> IntArray:
    """Bits (a0-b1, a1-b2, a2-b0 are diagonals) to the permutation (i, j, k), (8, 3).

    In it the diagonals are a_i-b_j, a_i-b_k, a_j-b_k; rows of -1 have no tetrahedra.
    """
    table = np.full((8, 3), -1, np.int64)
    for i, j, k in permutations(range(3)):
        diagonals = {(i, j), (i, k), (j, k)}
        bits = [(c, (c + 1) % 3) in diagonals for c in range(3)]
        table[4 * bits[0] + 2 * bits[1] + bits[2]] = (i, j, k)
    return table


_PRISM = _prism_table()


def _prisms(a: IntArray, b: IntArray, bits: np.ndarray) -> IntArray:
    """Three tetrahedra per prism with triangles a, b (P, 3), seen counter-clockwise from b."""
    perm = _PRISM[bits @ np.array([4, 2, 1])]
    ai, aj, ak = np.take_along_axis(a, perm, axis=1).T
    bi, bj, bk = np.take_along_axis(b, perm, axis=1).T
    tets = np.concatenate(
        [np.stack(t, axis=1) for t in ((ai, bi, bj, bk), (ai, aj, bk, bj), (ai, aj, ak, bk))]
    )
    odd = np.tile((perm[:, 1] - perm[:, 0]) % 3 == 2, 3)
    tets[odd] = tets[odd][:, [0, 1, 3, 2]]
    return tets


def _length(x: Array, a: IntArray, b: IntArray) -> Array:
    return np.linalg.norm(x[a] - x[b], axis=1)
