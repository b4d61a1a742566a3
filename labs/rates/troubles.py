"""Noise and troubles of recordings that are no cause: lost rows, uneven clocks, color."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Channel, Run

Array = NDArray[np.float64]
LOST_ROWS, UNEVEN_CLOCK, COLOR, TAILS = "lost_rows", "uneven_clock", "colored_noise", "heavy_tails"
TROUBLES = (LOST_ROWS, UNEVEN_CLOCK, COLOR, TAILS)
LOST_SHARE = 0.02  # of the rows of a recording
CLOCK_JITTER = 0.1  # of the time from sample to sample
AUTOCORRELATION = 0.6  # of colored noise, from sample to sample
FREEDOM = 3.0  # of Student's t, whose tails are heavy


def sample_times(rng: np.random.Generator, count: int, step_s: float, trouble: str) -> Array:
    """Times of the samples [s], even unless the clock is the trouble."""
    time = step_s * np.arange(float(count))
    jitter = CLOCK_JITTER * step_s * rng.uniform(-0.5, 0.5, count)
    jitter[0] = 0.0
    return time + jitter if trouble == UNEVEN_CLOCK else time


def with_noise(
    rng: np.random.Generator, run: Run, channels: Sequence[Channel], trouble: str
) -> tuple[Run, Run]:
    """A run without noise as it is recorded, and the same samples without noise."""
    count, sd = len(run.time_s), np.array([c.sd for c in channels])
    noise = sd * _unit_noise(rng, (count, len(channels)), trouble)
    kept = rng.random(count) >= LOST_SHARE
    kept[0] = True
    if trouble != LOST_ROWS:
        kept[:] = True
    clean = run.part(kept)
    return replace(clean, measured=clean.measured + noise[kept]), clean


def _unit_noise(rng: np.random.Generator, shape: tuple[int, int], trouble: str) -> Array:
    from scipy.signal import lfilter

    settling = 50
    longer = (shape[0] + settling, shape[1])
    if trouble == TAILS:
        heavy: Array = rng.standard_t(FREEDOM, longer)[settling:] / np.sqrt(
            FREEDOM / (FREEDOM - 2.0)
        )
        return heavy
    white = rng.standard_normal(longer)
    if trouble != COLOR:
        return white[settling:]
    scale = np.sqrt(1.0 - AUTOCORRELATION**2)
    colored: Array = scale * lfilter([1.0], [1.0, -AUTOCORRELATION], white, axis=0)[settling:]
    return colored
