"""Triangles of a surface that cross each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from diffsim.core.arrays import Array, IntArray

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
