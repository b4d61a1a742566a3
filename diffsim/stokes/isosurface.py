"""Closed surface of the part of a box where a level set is negative, by marching tetrahedra.

Every cell is split into six tetrahedra along its diagonal from the lowest to the highest corner
(Kuhn), the level set is linear in each. Faces of the box are split along the same diagonals and cut
by the same points, so the surface closes exactly, with sharp edges where it meets the box.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from diffsim.core.arrays import Array, IntArray, Mask

Indices = IntArray

NEAREST = 0.01
"""Crossings keep this share of an edge [-] from its ends: no triangle vanishes when written in
single precision, at the price of moving the surface by at most as much."""


def negative_part(coords: Sequence[Array], level: Array) -> tuple[Array, Indices]:
    """Boundary of {level < 0} in a box, outward normals; nodes with level 0 count as negative.

    Args:
        coords: Node coordinates of the three axes, ascending [m].
        level: Level set at the nodes, (n0, n1, n2).

    Returns:
        Vertices (V, 3) [m] and triangles (F, 3) int64; every edge has two triangles. Empty where
        the level set is positive everywhere.
    """
    inside = level <= 0.0
    strides = np.array([level.shape[1] * level.shape[2], level.shape[2], 1])
    pieces = [_interior(inside, strides)]
    for axis, high in itertools.product(range(3), (False, True)):
        pieces.append(_box_face(inside, strides, axis, high))
    return _assemble(coords, level, np.concatenate(pieces))


def wall(coords: Sequence[Array], level: Array) -> tuple[Array, Indices]:
    """The surface level = 0 alone, without the box; normals point to positive levels."""
    strides = np.array([level.shape[1] * level.shape[2], level.shape[2], 1])
    return _assemble(coords, level, _interior(level <= 0.0, strides))


# A triangle here is (3, 2) node indices: each vertex is the crossing of the edge between two nodes,
# or a node (twice the same index).


def _interior(inside: Mask, strides: Indices) -> Indices:
    """Triangles on level = 0, (F, 3, 2)."""
    corners = list(itertools.product((0, 1), repeat=3))
    views = [inside[tuple(slice(b, n - 1 + b) for b, n in zip(c, inside.shape, strict=True))]
             for c in corners]  # fmt: skip
    count = np.sum(views, axis=0, dtype=np.int8)
    cells = np.argwhere((count > 0) & (count < 8))
    low = cells @ strides
    flat = inside.ravel()
    pieces: list[Indices] = []
    for order in itertools.permutations(range(3)):
        steps = np.concatenate([[0], np.cumsum(strides[list(order)])])
        tets = low[:, None] + steps
        # position of the four nodes in units of cells, to orient the triangles
        places = np.zeros((4, 3))
        for k, axis in enumerate(order):
            places[k + 1 :, axis] += 1.0
        code = flat[tets] @ np.array([1, 2, 4, 8])
        for pattern in range(1, 15):
            chosen = tets[code == pattern]
            if len(chosen):
                pieces.extend(chosen[:, t] for t in _cut_tet(pattern, places))
    return np.concatenate(pieces) if pieces else np.zeros((0, 3, 2), np.int64)


def _cut_tet(pattern: int, places: Array) -> list[Indices]:
    """Triangles of a cut tetrahedron as (3, 2) local nodes; ``pattern``: bit per negative node."""
    neg = [k for k in range(4) if pattern >> k & 1]
    pos = [k for k in range(4) if not pattern >> k & 1]
    if len(neg) == 2:
        loop = [(neg[0], pos[0]), (neg[0], pos[1]), (neg[1], pos[1]), (neg[1], pos[0])]
    else:
        loop = [(n, p) for n in neg for p in pos]
    out = places[pos].mean(0) - places[neg].mean(0)
    return _fan(loop, places, out)


def _box_face(inside: Mask, strides: Indices, axis: int, high: bool) -> Indices:
    """Triangles of the negative part of one face of the box, (F, 3, 2)."""
    a, b = (k for k in range(3) if k != axis)
    shape = inside.shape
    start = (shape[axis] - 1) * strides[axis] if high else 0
    i, j = np.meshgrid(np.arange(shape[a] - 1), np.arange(shape[b] - 1), indexing="ij")
    low = start + i.ravel() * strides[a] + j.ravel() * strides[b]
    flat = inside.ravel()
    out = np.zeros(3)
    out[axis] = 1.0 if high else -1.0
    pieces: list[Indices] = []
    for first, second in ((a, b), (b, a)):
        steps = np.array([0, strides[first], strides[first] + strides[second]])
        places = np.zeros((3, 3))
        places[1:, first] = 1.0
        places[2, second] = 1.0
        triangles = low[:, None] + steps
        code = flat[triangles] @ np.array([1, 2, 4])
        for pattern in range(1, 8):
            chosen = triangles[code == pattern]
            if len(chosen):
                pieces.extend(chosen[:, t] for t in _clip_triangle(pattern, places, out))
    return np.concatenate(pieces) if pieces else np.zeros((0, 3, 2), np.int64)


def _clip_triangle(pattern: int, places: Array, out: Array) -> list[Indices]:
    neg = [k for k in range(3) if pattern >> k & 1]
    loop = []
    for k in range(3):  # around the triangle: its negative nodes, and where its edges cross
        n = (k + 1) % 3
        if k in neg:
            loop.append((k, k))
        if (k in neg) != (n in neg):
            loop.append((min(k, n), max(k, n)))
    return _fan(loop, places, out)


def _fan(loop: list[tuple[int, int]], places: Array, out: Array) -> list[Indices]:
    """A polygon as triangles with normals along ``out``; midpoints stand for the crossings."""
    middle = np.array([0.5 * (places[p] + places[q]) for p, q in loop])
    triangles = [(0, k, k + 1) for k in range(1, len(loop) - 1)]
    normal = sum(np.cross(middle[j] - middle[i], middle[k] - middle[i]) for i, j, k in triangles)
    if normal @ out < 0:
        triangles = [(i, k, j) for i, j, k in triangles]
    return [np.array([loop[i] for i in t]) for t in triangles]


def _assemble(coords: Sequence[Array], level: Array, pairs: Indices) -> tuple[Array, Indices]:
    if not len(pairs):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    low, high = pairs.min(-1), pairs.max(-1)
    keys, faces = np.unique(low * level.size + high, return_inverse=True)
    low, high = keys // level.size, keys % level.size
    values = level.ravel()
    share = np.zeros(len(keys))
    cut = low != high
    share[cut] = values[low[cut]] / (values[low[cut]] - values[high[cut]])
    share[cut] = share[cut].clip(NEAREST, 1.0 - NEAREST)
    ends = [
        np.stack([c[k] for c, k in zip(coords, np.unravel_index(n, level.shape), strict=True)], -1)
        for n in (low, high)
    ]
    vertices = ends[0] + share[:, None] * (ends[1] - ends[0])
    return vertices, faces.reshape(-1, 3).astype(np.int64)
