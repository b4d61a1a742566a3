"""Which points of a regular grid a closed surface encloses, by counting crossings along z."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError

_BUDGET = 4_000_000
_TRIES = 5


def grid_inside(x: Array, faces: IntArray, first: Array, spacing: float, counts: IntArray) -> Array:
    """Points ``first + spacing * (i, j, k)`` inside a closed surface.

    The points of a column (i, j) are inside after an odd number of crossings. Columns are moved
    sideways by 1e-6 of the spacing, so that none runs through an edge.

    Args:
        x: Surface vertices, (V, 3) [m].
        faces: Triangles, (F, 3), closed.
        first: Point (0, 0, 0), (3,) [m].
        spacing: Distance of neighbors [m].
        counts: Number of points along each axis, (3,).

    Returns:
        (nx, ny, nz) bool.
    """
    rng = np.random.default_rng(0)
    for _ in range(_TRIES):
        shift = spacing * 1e-6 * rng.uniform(-1.0, 1.0, 2)
        column, height = _crossings(x, faces, first[:2] + shift, spacing, counts[:2])
        level = np.ceil((height - first[2]) / spacing)  # first k above the crossing
        level = np.clip(level, 0, counts[2]).astype(np.int64)
        size = int(counts[0] * counts[1])
        toggles = np.bincount(
            column * (counts[2] + 1) + level, minlength=size * int(counts[2] + 1)
        ).reshape(size, -1)
        crossed = np.cumsum(toggles, axis=1) & 1
        if not crossed[:, -1].any():  # every column leaves as often as it enters
            return crossed[:, :-1].astype(bool).reshape(counts.tolist())
    raise MeshError(
        "the surface is not closed seen along z: some lines enter it without leaving; merge close "
        "vertices, for example with MeshLab's 'Merge Close Vertices'"
    )


def _crossings(
    x: Array, faces: IntArray, first: Array, spacing: float, counts: IntArray
) -> tuple[IntArray, Array]:
    """Columns that triangles cross, and at which height: (C,) and (C,) [m]."""
    corners = x[faces]
    flat = (corners[..., :2] - first) / spacing  # columns are at whole numbers
    low = np.clip(np.ceil(flat.min(axis=1)), 0, counts).astype(np.int64)
    high = np.clip(np.floor(flat.max(axis=1)) + 1, 0, counts).astype(np.int64)
    span = np.maximum(high - low, 0)
    num = span.prod(axis=1)
    columns, heights = [], []
    start = 0
    ends = np.cumsum(num)
    while start < len(faces):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _BUDGET)))
        tri = np.repeat(np.arange(start, stop), num[start:stop])
        rank = np.arange(len(tri)) + done - (ends[tri] - num[tri])
        i = low[tri, 0] + rank // np.maximum(span[tri, 1], 1)
        j = low[tri, 1] + rank % np.maximum(span[tri, 1], 1)
        hit, z = _heights(flat[tri], corners[tri, :, 2], np.stack([i, j], axis=1))
        columns.append((i * counts[1] + j)[hit])
        heights.append(z[hit])
        start = stop
    return np.concatenate(columns), np.concatenate(heights)


def _heights(flat: Array, z: Array, points: IntArray) -> tuple[np.ndarray, Array]:
    """Is each point inside its triangle (P, 3, 2), and the triangle's height there.

    Both neighbors of an edge compute its sign from the same two numbers in the same order, so a
    point never falls between them.
    """
    p = points.astype(np.float64)
    area = []
    for c in range(3):
        a, b = flat[:, (c + 1) % 3], flat[:, (c + 2) % 3]
        swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
        lo, hi = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
        d, q = hi - lo, p - lo
        area.append(np.where(swap, -1.0, 1.0) * (d[:, 0] * q[:, 1] - d[:, 1] * q[:, 0]))
    w = np.stack(area, axis=1)
    hit = np.asarray((w > 0).all(axis=1) | (w < 0).all(axis=1))
    total = w.sum(axis=1)
    return hit, (w * z).sum(axis=1) / np.where(total == 0, 1.0, total)
