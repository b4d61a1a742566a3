"""A record and its slopes at one point, before any whitening.

Simulations are what a diagnosis pays for. Their results do not depend on the noise, so they are
kept as they come, and a new estimate of the noise weighs them afresh without simulating again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from diffsim.data.study import Run
from diffsim.identify.problem import PredictionError, Problem

Array = NDArray[np.float64]


class Unwhitened:
    """Takes every sample as it is, missing ones too."""

    def matrix(self, run: Run) -> sparse.csr_array:
        """Identity."""
        return sparse.eye_array(run.measured.size, format="csr")


@dataclass(frozen=True, eq=False)
class Local:
    """S(x) and dS/dx at x; all samples of all runs of a problem in a row, N of them.

    Attributes:
        x: (n,) coordinates of the problem.
        record: (N,) predicted.
        idx: Coordinates whose slopes are known.
        columns: (N, len(idx)) slopes.
        stray: By what share of its movement the record strayed from the slopes since they were
            simulated; 0: they belong to this point.
    """

    x: Array
    record: Array
    idx: tuple[int, ...]
    columns: Array
    stray: float = 0.0

    def slopes(self, wanted: Sequence[int]) -> Array:
        """(N, len(wanted)) slopes; all must be known."""
        place = {i: k for k, i in enumerate(self.idx)}
        return self.columns[:, [place[i] for i in wanted]]

    def joined(self, other: Local) -> Local:
        """Slopes of ``other`` beside those known here, which win."""
        more = [i for i in other.idx if i not in set(self.idx)]
        columns = np.hstack([self.columns, other.slopes(more)])
        return replace(self, idx=(*self.idx, *more), columns=columns)


def local_at(
    problem: Problem, x: Array, only: Sequence[int] | None = None, *, screen: bool = False
) -> Local:
    """Simulate a problem's runs at x.

    Args:
        problem: Its whitener plays no role.
        x: (n,).
        only: Coordinates to differentiate; all if None.
        screen: Non-smooth effects by a secant from here.

    Raises:
        PredictionError: a simulation left the range of numbers.
    """
    idx = tuple(range(len(x))) if only is None else tuple(only)
    left, slopes = _raw(problem).linearise(x, screen=screen, only=idx)
    slopes = slopes[:, list(idx)]
    if not np.isfinite(slopes).all():
        bad = [problem.names[i] for i, c in zip(idx, slopes.T, strict=True) if not _is_finite(c)]
        raise PredictionError(
            f"the prediction is not finite a small step along {', '.join(bad)}; narrow their "
            "bounds, priors or typical sizes, or mend the scene"
        )
    return Local(x, measured_of(problem) - left, idx, slopes)


def record_at(problem: Problem, x: Array) -> Array:
    """(N,) predicted."""
    return measured_of(problem) - _raw(problem).residual(x)


def measured_of(problem: Problem) -> Array:
    """(N,) of all runs; zero where nothing was recorded."""
    return np.concatenate([np.nan_to_num(run.measured).ravel() for run in problem.runs])


def whitened(problem: Problem, rows: Array) -> Array:
    """(num_valid, ...) of (N, ...)."""
    edges = np.cumsum([run.measured.size for run in problem.runs])[:-1]
    parts = np.split(rows, edges)
    return np.concatenate([problem.whiten(r, p) for r, p in zip(problem.runs, parts, strict=True)])


def _is_finite(column: Array) -> bool:
    return bool(np.isfinite(column).all())


def _raw(problem: Problem) -> Problem:
    return replace(problem, whitener=Unwhitened())
