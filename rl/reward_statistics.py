"""Few runs, honestly summed up: interquartile means, bootstrap intervals, times to a goal.

Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice", 2021.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Row = dict[str, Any]


def interquartile_mean(values: Array, axis: int = 0) -> Array:
    """Mean without the lowest and the highest quarter (rounded down) of the values."""
    from scipy import stats

    out: Array = np.asarray(stats.trim_mean(values, 0.25, axis=axis))
    return out


def bootstrap_interval(
    values: Array, *, level: float = 0.95, resamples: int = 2000, seed: int = 0
) -> tuple[Array, Array]:
    """Percentile interval of the interquartile mean over the first axis.

    Args:
        values: (runs, ...).
        level: Level of confidence.
        resamples, seed: Number of the bootstrap's draws, and their seed; whole runs are drawn.

    Returns:
        Low and high, (...); both the value itself where there is but one run.
    """
    from scipy import stats

    values = np.asarray(values, dtype=np.float64)
    if len(values) < 2:
        return values[0], values[0]
    result = stats.bootstrap(
        (values,),
        interquartile_mean,
        axis=0,
        confidence_level=level,
        n_resamples=resamples,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(seed),
    )
    return result.confidence_interval.low, result.confidence_interval.high


def held(rows: Sequence[Row], axis: str, at: Array) -> Array:
    """Reward of a run at places of an axis: that of the last rating before, held.

    Ratings that broke down (NaN) count as the run's first one: as if nothing had been learned.

    Args:
        rows: Ratings, in order.
        axis: Such as "steps".
        at: Places, (n,).
    """
    x = np.array([r[axis] for r in rows], dtype=np.float64)
    y = np.array([r["reward"] for r in rows], dtype=np.float64)
    y = np.where(np.isfinite(y), y, y[0])
    out: Array = y[np.clip(np.searchsorted(x, at, side="right") - 1, 0, None)]
    return out


def first_reach(rows: Sequence[Row], axis: str, goal: float) -> float:
    """Where a run is first rated at least ``goal``; infinity where it never is."""
    return next((float(r[axis]) for r in rows if r["reward"] >= goal), math.inf)


@dataclass(frozen=True)
class Scale:
    """Normalized reward (thesis Fig. 4-17)."""

    zero: float  # mean reward of untrained networks
    one: float  # final reward of training by gradient, interquartile mean over its runs

    def __call__(self, reward: Array | float) -> Array:
        """(reward - zero) / (one - zero).

        Raises:
            ValueError: training by gradient gained nothing, so there is no unit.
        """
        if not self.one > self.zero:
            raise ValueError(
                f"training by gradient must gain something to be the unit of reward, got a final "
                f"reward of {self.one:.4g} where untrained networks earn {self.zero:.4g}"
            )
        out: Array = (np.asarray(reward) - self.zero) / (self.one - self.zero)
        return out
