"""Which hexahedra have the same shape: a voxel grid has one, and needs one set of gradients."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import Array, IntArray

RELATIVE_QUANTUM = 1e-12


def congruence_classes(x: Array, hexes: IntArray) -> tuple[IntArray, IntArray]:
    """Group elements that are translates of each other, up to rounding.

    Edge vectors from local node 0 are rounded to 1e-12 of the largest edge vector (or to 64 units
    in the last place of the largest coordinate, when that is coarser).

    Args:
        x: Node positions, (V, 3) [m].
        hexes: Node indices, (E, 8).

    Returns:
        ``(representative, class_idx)``: one element per class, (C,) in order of first appearance,
        and the class of each element, (E,).
    """
    edges = x[hexes[:, 1:]] - x[hexes[:, :1]]
    edges = edges.reshape(len(hexes), 21)
    scale = float(np.abs(edges).max(initial=0.0))
    noise = 64.0 * np.finfo(np.float64).eps * float(np.abs(x).max(initial=0.0))
    quantum = max(RELATIVE_QUANTUM * scale, noise, np.finfo(np.float64).tiny)
    edges /= quantum
    best = _group(np.rint(edges))
    if len(best[0]) > 1:  # rounding may have split one shape where a length is near a half
        shifted = _group(np.rint(edges + 1.0 / 3.0))
        best = min(best, shifted, key=lambda groups: len(groups[0]))
    return best


def _group(rows: Array) -> tuple[IntArray, IntArray]:
    """Equal rows of integers stored as float64, by a 64-bit hash that is verified."""
    multipliers = np.random.default_rng(0).integers(1, 2**63, rows.shape[1], np.uint64)
    keys = np.zeros(len(rows), np.uint64)
    for column, multiplier in enumerate(multipliers):
        keys += rows[:, column].astype(np.int64).view(np.uint64) * (multiplier | np.uint64(1))
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    if not np.array_equal(rows[first[inverse]], rows):  # a collision: group the rows themselves
        _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first).astype(np.int64), rank[inverse.reshape(-1)]
