"""Take in a closed triangle surface: a trimesh or a file; refuse holes, say where they are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.mesh.surface_bodies import enclosed_volume, refuse_crossings
from diffsim.mesh.surface_check import check_indices

if TYPE_CHECKING:
    import trimesh


_TOUCH = 1e-9  # of the triangles' size: what merely touches does not cross
_MOST_PAIRS = 2_000_000  # looked at together


def crossing_triangles(x: Array, faces: IntArray, most: int = 1000) -> IntArray:
    """Pairs of triangles that run through each other, (K, 2), K <= ``most``.

    Triangles that touch, lie in one plane or share an edge do not cross.

    Args:
        x: Vertices, (V, 3) [m].
        faces: Triangles, (F, 3).
        most: Number of pairs after which the search ends.
    """
    corners = x[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    found: list[IntArray] = []
    for pairs in _close_pairs(low, high):
        a, b = pairs.T
        near = ((low[a] <= high[b]) & (low[b] <= high[a])).all(axis=1)
        pairs = pairs[near]
        shared = (faces[pairs[:, 0], :, None] == faces[pairs[:, 1], None, :]).sum(axis=(1, 2))
        pairs = pairs[shared < 2]
        found.append(pairs[_cross(corners[pairs[:, 0]], corners[pairs[:, 1]])])
        if sum(map(len, found)) >= most:
            break
    return np.concatenate(found)[:most] if found else np.empty((0, 2), np.int64)


def _close_pairs(low: Array, high: Array) -> Iterator[IntArray]:
    """Pairs of boxes, each once, whose spheres meet; by classes of size, as spheres then fit."""
    from scipy.spatial import cKDTree

    center, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1)
    size = np.frexp(radius)[1]
    classes = [np.flatnonzero(size == s) for s in np.unique(size)]
    trees = [cKDTree(center[idx]) for idx in classes]
    for k, (own, tree) in enumerate(zip(classes, trees, strict=True)):
        for others, other_tree in zip(classes[k:], trees[k:], strict=True):
            reach = float(radius[own].max() + radius[others].max())
            parts = [own]
            while parts:
                part = parts.pop()
                here = tree if part is own else cKDTree(center[part])
                if len(part) > 1 and here.count_neighbors(other_tree, reach) > _MOST_PAIRS:
                    parts += np.array_split(part, 2)
                    continue
                met = here.sparse_distance_matrix(other_tree, reach, output_type="ndarray")
                pairs = np.stack([part[met["i"]], others[met["j"]]], axis=1)
                yield pairs if others is not own else pairs[pairs[:, 0] < pairs[:, 1]]


def _cross(a: Array, b: Array) -> np.ndarray:
    """Whether triangles cross, pair by pair: (N, 3, 3) and (N, 3, 3) -> (N,).

    Where each has corners to both sides of the other's plane, each cuts a piece out of the line of
    both planes; the pieces must overlap (Moeller 1997, "A Fast Triangle-Triangle Intersection
    Test").
    """
    size = np.maximum(np.ptp(a, axis=1), np.ptp(b, axis=1)).max(axis=1)
    normals = [np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]) for t in (a, b)]
    of_a, of_b = _heights(a, b, normals[1], size), _heights(b, a, normals[0], size)
    out = np.all([(h.min(axis=1) < 0) & (h.max(axis=1) > 0) for h in (of_a, of_b)], axis=0)
    both = np.flatnonzero(out)  # few: neighbors on a smooth surface are to one side
    line = np.cross(normals[0][both], normals[1][both])
    middle = a[both, :1]
    pieces = [
        _piece(np.einsum("nkc,nc->nk", t[both] - middle, line), h[both])
        for t, h in ((a, of_a), (b, of_b))
    ]
    overlap = np.minimum(*(p[1] for p in pieces)) - np.maximum(*(p[0] for p in pieces))
    out[both] = overlap > _TOUCH * size[both] * np.linalg.norm(line, axis=1)
    return out


def _heights(a: Array, b: Array, normal: Array, size: Array) -> Array:
    """Over the plane of ``b`` of the corners of ``a``, times its normal; 0 on it, (N, 3)."""
    height = np.einsum("nkc,nc->nk", a - b[:, :1], normal)
    on = _TOUCH * (size * np.linalg.norm(normal, axis=1))[:, None]
    return np.where(np.abs(height) > on, height, 0.0)


def _piece(along: Array, height: Array) -> tuple[Array, Array]:
    """From where to where a triangle cuts the other's plane, along the line of both, (N,) each."""
    ends = [np.where(height == 0.0, along, np.nan)]
    after, to = np.roll(along, -1, axis=1), np.roll(height, -1, axis=1)
    through = height * to < 0.0
    share = height / np.where(through, height - to, 1.0)
    ends.append(np.where(through, along + share * (after - along), np.nan))
    cuts = np.concatenate(ends, axis=1)
    return np.nanmin(cuts, axis=1), np.nanmax(cuts, axis=1)


SurfaceLike: TypeAlias = "trimesh.Trimesh | str | Path"
SIDES = (1e-70, 1e70)
"""Least and largest side of a surface [m]: squares of areas must be numbers."""


def closed_surface(surface: SurfaceLike, *, may_cross: bool = False) -> tuple[Array, IntArray]:
    """Vertices (V, 3) [m] and triangles (F, 3), closed and oriented outwards.

    Vertices in the same place are merged (STL files store each triangle on its own) and triangles
    that collapse by that are dropped.

    Args:
        surface: A trimesh or the path of a file.
        may_cross: Whether triangles may run through each other: of what was asked before.

    Raises:
        TypeError: neither a trimesh nor a path.
        MeshError: faces of vertices that there are not, open edges, edges of more than two
            triangles, inconsistent orientation, no volume, triangles that cross, a size whose
            areas have no squares.
    """
    import trimesh

    if isinstance(surface, str | Path):
        from diffsim.mesh.files import load_surface

        surface = load_surface(surface)
    if not isinstance(surface, trimesh.Trimesh):
        raise TypeError(
            "surface must be a trimesh.Trimesh or the path of a surface file, got "
            f"{type(surface).__name__}"
        )
    x = np.asarray(surface.vertices, np.float64)
    if len(surface.faces) == 0:
        raise MeshError("the surface has no triangles")
    if not np.isfinite(x).all():
        raise MeshError("the surface has vertices that are not finite")
    check_indices(np.asarray(surface.faces, np.int64), x)
    far = float(np.abs(x).max())
    if not SIDES[0] <= far <= SIDES[1]:
        raise MeshError(
            f"the surface must reach {SIDES[0]:g} to {SIDES[1]:g} m from the origin, where squares "
            f"of areas are numbers, got {far:.3g} m; check its unit"
        )
    x, inverse = np.unique(x, axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[np.asarray(surface.faces, np.int64)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _check_closed(faces, len(x))
    volume = enclosed_volume(x, faces)
    extent = x.max(axis=0) - x.min(axis=0)
    if abs(volume) <= 1e-12 * float(extent.max()) ** 3:
        raise MeshError(
            f"the surface encloses no volume ({volume:.3g} m^3): it is flat, or parts that are "
            "turned against each other cancel"
        )
    if not may_cross:
        refuse_crossings(x, faces, crossing_triangles(x, faces))
    return x, faces if volume > 0 else faces[:, ::-1]


def _check_closed(faces: IntArray, num_vertices: int) -> None:
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs = np.sort(directed, axis=1)
    keys, first, count = np.unique(
        pairs[:, 0] * num_vertices + pairs[:, 1], return_index=True, return_counts=True
    )
    open_edges = first[count == 1]
    if len(open_edges):
        plural = "s" * (len(open_edges) > 1)
        raise MeshError(
            f"the surface is not watertight: {len(open_edges)} open edge{plural} of {len(keys)}, "
            f"in triangles {', '.join(str(int(i) // 3) for i in open_edges[:6])}"
            f"{', ...' * (len(open_edges) > 6)}; close the holes, for example with "
            "trimesh.repair.fill_holes(surface) (pip install networkx), MeshLab's 'Close Holes' or "
            "Blender's '3D-Print: Make Manifold'",
            tuple(int(i) // 3 for i in open_edges[:1000]),
        )
    crowded = first[count % 2 == 1]
    if len(crowded):
        raise MeshError(
            f"the surface is not watertight: {len(crowded)} edges belong to an odd number of "
            "triangles; remove inner walls, for example with MeshLab's 'Remove Non Manifold Edges'",
            tuple(int(i) // 3 for i in crowded[:1000]),
        )
    sign = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    balance = np.zeros(len(keys), np.int64)
    np.add.at(balance, np.searchsorted(keys, pairs[:, 0] * num_vertices + pairs[:, 1]), sign)
    twisted = first[balance != 0]
    if len(twisted):
        raise MeshError(
            f"the surface's triangles are not oriented alike: {len(twisted)} edges are run through "
            "twice in one direction; mend with trimesh.repair.fix_normals(surface) (pip install "
            "networkx)",
            tuple(int(i) // 3 for i in twisted[:1000]),
        )
