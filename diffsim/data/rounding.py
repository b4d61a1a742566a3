"""Steps of a channel: readings that were rounded by the sensor, a converter or the file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FEWEST_VALUES = 8  # different readings from which on steps are no coincidence
ON_STEP = 0.05  # of a step: how far off it a reading may lie
ROUND = 1e-9  # of the range: readings that close are equal


def step_of(readings: Array) -> float | None:
    """Step on whole numbers of which all readings lie, from any zero; None where there is none.

    Args:
        readings: Readings of a channel, (num_samples,); NaN where there are none.
    """
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < FEWEST_VALUES:
        return None
    gaps = np.diff(values)
    step = float(gaps[gaps > ROUND * np.ptp(values)].min(initial=np.inf))
    places = (values - values[0]) / step
    if not np.isfinite(step) or np.abs(places - np.round(places)).max() > ON_STEP:
        return None
    return step * float(places[-1] / np.round(places[-1]))  # the mean of many gaps


def rounding_sd(readings: Array) -> float:
    """Standard deviation of what rounding does to readings, step / sqrt(12); 0 without steps."""
    step = step_of(readings)
    return 0.0 if step is None else step / float(np.sqrt(12.0))
