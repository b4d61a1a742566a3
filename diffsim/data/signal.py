"""Noise of a signal by differences of its samples."""

from __future__ import annotations

import math

import numpy as np

from diffsim.core.arrays import Array


def noise_std(x: Array) -> float:
    """Sensor noise from second differences, std / sqrt(6): blind to level and slow motion.

    Args:
        x: (T,) a quiet stretch of one coordinate; gaps are skipped.
    """
    second = np.diff(np.asarray(x, dtype=np.float64), n=2)
    second = second[np.isfinite(second)]
    if len(second) < 10:
        raise ValueError(f"{len(second)} second differences; a noise level needs at least 10")
    return float(np.sqrt(np.mean(second**2) / 6.0))


def scatter(differences: Array, order: int) -> Array:
    """Noise sd behind differences of samples, from their median: blind to spikes and slow motion.

    Args:
        differences: (T, ...) of one order, as of ``numpy.diff``; NaN are passed over.
        order: How often the samples were differenced.

    Returns:
        (...) in the unit of the samples.
    """
    middle = np.nanmedian(np.abs(differences), axis=0)
    return np.asarray(middle / 0.6745 / np.sqrt(float(math.comb(2 * order, order))))
