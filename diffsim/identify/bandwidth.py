"""How fast what a model leaves changes: the cosines that hold more than white noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft

from diffsim.core.arrays import Array
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.problem import Problem

FIRST = 4  # cosines of the narrowest band; each further one is twice as wide


def octaves_of(series: Array, stretch: float = 1.0) -> tuple[Array, Array]:
    """Energy of the cosines of an octave, and how many they are, (num_octaves,) each.

    Args:
        series: Samples of white noise of variance one and what stands out of it, (T, c); zero where
            none was measured.
        stretch: How many times as long the record is by whose length cosines are counted.
    """
    energy = np.sum(fft.dct(series, axis=0, norm="ortho") ** 2, axis=1)
    place = (np.arange(len(series)) + 1.0) * stretch
    octave = np.ceil(np.log2(np.maximum(place / FIRST, 1.0))).astype(np.int64)
    count = float(series.shape[1]) * np.bincount(octave).astype(np.float64)
    return np.asarray(np.bincount(octave, energy), dtype=np.float64), count


def num_cosines_of(problem: Problem, residual: Array) -> int:
    """Cosines over the longest run that what a fit leaves asks for: doubled until the evidence
    stops rising.

    Args:
        problem: Problem whose runs were fitted.
        residual: Whitened residual, (num_valid,).
    """
    spans = [float(np.ptp(run.time_s)) for run in problem.runs]
    octaves = []
    for run, own, span in zip(problem.runs, problem.by_run(residual), spans, strict=True):
        if span > 0.0:
            octaves.append(octaves_of(problem.on_grid(run, own), max(spans) / span))
    return num_cosines(band_nats(octaves)) if octaves else FIRST


def band_nats(octaves: Sequence[tuple[Array, Array]]) -> Array:
    """Evidence that the cosines of a band, of several records together, hold more than noise, by
    the number of its octaves [nats]; the common amplitude is the best one.

    Args:
        octaves: Energies and counts of every record, as ``octaves_of`` returns them.
    """
    size = max(len(energy) for energy, _ in octaves)
    energy, count = np.zeros((2, size))
    for own, number in octaves:
        energy[: len(own)] += own
        count[: len(own)] += number
    energy, count = np.cumsum(energy), np.maximum(np.cumsum(count), 1.0)
    ratio = np.maximum(energy / count, 1.0)
    return np.asarray(0.5 * count * (ratio - 1.0 - np.log(ratio)))


def num_cosines(nats: Array) -> int:
    """Cosines of the narrowest band that no wider one beats."""
    return FIRST * 2 ** int(np.argmax(nats > nats.max() - KEEP_NATS))
