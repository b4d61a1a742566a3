"""Plates with holes as closed surfaces, the top level or tilted: what clips and frames are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import Delaunay

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.errors import MeshError

if TYPE_CHECKING:
    import trimesh

_FLAT = 1e-9  # height over length of triangles between three points of one straight side: rounding


def circle(
    radius: float, center: Sequence[float] | Array = (0.0, 0.0), segments: int = 48
) -> Array:
    """Corners of a regular polygon inside the circle, counterclockwise, (segments, 2)."""
    angles = 2.0 * np.pi / segments * np.arange(segments)
    return np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def refined(loop: Array, spacing: float) -> Array:
    """A closed loop with extra points, so that no side is longer than ``spacing``."""
    pieces = []
    for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        pieces.append(a + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * (b - a))
    return np.concatenate(pieces)


def perforated_prism(
    outline: Array,
    holes: Sequence[Array],
    height: float,
    slope: Sequence[float] | Array = (0.0, 0.0),
    holes_below: Sequence[Array] | None = None,
) -> trimesh.Trimesh:
    """A plate on z = 0 with holes from end to end, its top z = height + slope . (x, y).

    Args:
        outline: Closed loop without crossings, either sense, (n, 2).
        holes: Loops inside it that keep clear of each other, each (m, 2).
        height: Height of the top at the origin, in the unit of the outline.
        slope: Rise of the top per length along x and y.
        holes_below: The same loops at z = 0, for holes that are not upright.

    Returns:
        A closed surface, oriented outwards.

    Raises:
        MeshError: holes leave the outline, meet, or have sides too long for their distance.
    """
    import trimesh

    outline = outline if _area(outline) > 0.0 else outline[::-1]
    flip = [h if _area(h) < 0.0 else h[::-1] for h in holes]
    below = holes if holes_below is None else holes_below
    upper = [outline, *flip]
    lower = [outline, *(h if _area(h) < 0.0 else h[::-1] for h in below)]
    flat, ground = np.concatenate(upper), np.concatenate(lower)
    n = len(flat)
    top = np.column_stack([flat, height + flat @ np.asarray(slope)])
    bottom = np.column_stack([ground, np.zeros(n)])
    i, j = _sides(upper).T
    walls = [np.column_stack([i, j, n + j]), np.column_stack([i, n + j, n + i])]
    faces = [_triangulate(lower)[:, ::-1], n + _triangulate(upper), *walls]
    return trimesh.Trimesh(np.concatenate([bottom, top]), np.concatenate(faces), process=False)


def inside(points: Array, loops: Sequence[Array]) -> Mask:
    """Whether points lie within an odd number of closed loops, (num_points,)."""
    x, y = points[:, :1], points[:, 1:]
    crossings = np.zeros(len(points), dtype=int)
    for loop in loops:
        a, b = loop, np.roll(loop, -1, axis=0)
        spans = (a[:, 1] <= y) != (b[:, 1] <= y)
        rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
        at = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
        crossings += (spans & (at > x)).sum(axis=1)
    return crossings % 2 == 1


def _triangulate(loops: Sequence[Array]) -> IntArray:
    """Delaunay triangles between the loops, counterclockwise; their border must be the loops."""
    flat = np.concatenate(loops)
    triangles = Delaunay(flat).simplices.astype(np.int64)
    triangles = triangles[inside(flat[triangles].mean(axis=1), loops)]
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles[turn < 0.0] = triangles[turn < 0.0][:, ::-1]
    lengths = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    triangles = triangles[np.abs(turn) > _FLAT * lengths**2]
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(e) for e in edges.tolist()}
    border = {e for e in directed if e[::-1] not in directed}
    wanted = {tuple(e) for e in _sides(loops).tolist()}
    if border != wanted:
        raise MeshError(
            f"{len(wanted - border)} sides of the outline or its holes are crossed by triangles; "
            "refine the loops or move holes away from each other and from the outline",
            tuple(sorted({i for side in wanted - border for i in side})),
        )
    return triangles


def _sides(loops: Sequence[Array]) -> IntArray:
    """Point pairs along all loops, (num_points, 2)."""
    pairs, start = [], 0
    for loop in loops:
        here = start + np.arange(len(loop))
        pairs.append(np.column_stack([here, np.roll(here, -1)]))
        start += len(loop)
    return np.concatenate(pairs)


def _area(loop: Array) -> float:
    x, y = loop.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
