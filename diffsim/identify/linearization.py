"""Predicted records and their derivatives at one point, before any whitening.

Simulations are what a diagnosis pays for. Their results do not depend on the noise: a new estimate
of the noise weighs them again without another simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.core.memo import Aside
from diffsim.data.study import Run
from diffsim.identify.problem import PredictionError, Problem

ROUNDING = 1e-6  # noise sd: a change of the whole record below it is rounding


@dataclass(frozen=True, eq=False)
class Linearization:
    """S and dS/du at x, with the N samples of all runs of a problem in a row.

    Slopes are by the scaled coordinates u (``Problem.scaled``), in which records are nearly linear:
    slopes of a size elsewhere need no rescaling.
    """

    x: Array  # standardized coordinates of the problem, (n,)
    record: Array  # predicted samples of all channels, (N,) [unit of the channel]
    idx: tuple[int, ...]  # coordinates whose slopes are known
    columns: Aside = Aside()  # slopes by these scaled coordinates, (N, len(idx))
    # summed relative error of the linear prediction over the steps taken since the slopes were
    # simulated [-]; 0: they were simulated at this x
    slope_error: float = 0.0

    def slopes(self, wanted: Sequence[int]) -> Array:
        """Slopes along some known coordinates, (N, len(wanted)); not to be written to."""
        if tuple(wanted) == self.idx:
            return self.columns
        place = {i: k for k, i in enumerate(self.idx)}
        return self.columns[:, [place[i] for i in wanted]]

    def joined(self, other: Linearization) -> Linearization:
        """The linearization with slopes of another point along coordinates that are missing
        here."""
        more = [i for i in other.idx if i not in set(self.idx)]
        columns = np.hstack([self.columns, other.slopes(more)])
        return replace(self, idx=(*self.idx, *more), columns=columns)


def linearization_at(
    problem: Problem, x: Array, only: Sequence[int] | None = None, *, screen: bool = False
) -> Linearization:
    """Simulate a problem's runs at x and differentiate them.

    Args:
        problem: Model and runs; the whitener is not used.
        x: Standardized coordinates, (n,).
        only: Coordinates to differentiate; all if None.
        screen: Differentiate non-smooth effects by a secant from here.

    Raises:
        PredictionError: a simulation left the range of numbers.
    """
    idx = tuple(range(len(x))) if only is None else tuple(only)
    record, slopes = problem.linearize_record(x, screen=screen, only=idx)
    # the square of all slopes, over noise of 1e-9 and less, is a number
    is_number = (np.abs(slopes) < 1e140).all(0)  # false for NaN, too
    if not is_number.all():
        bad = [problem.names[idx[k]] for k in np.flatnonzero(~is_number)]
        raise PredictionError(
            "the prediction leaves the range of numbers a small step along "
            f"{', '.join(bad)}; narrow their bounds, priors or typical sizes, or mend the scene"
        )
    return Linearization(x, record, idx, slopes)


def records_at(problem: Problem, points: Array) -> Array:
    """Predicted samples of all runs at K points, (K, N) [unit of the channel].

    Args:
        problem: Model and runs; the whitener is not used.
        points: Standardized coordinates, (K, n).

    Returns:
        NaN in the rows of points that cannot be simulated.
    """
    try:
        return problem.records(points)
    except DiffsimError:  # one of them: the others may do
        rows = np.full((len(points), sum(run.measured.size for run in problem.runs)), np.nan)
        for row, point in zip(rows, points, strict=True):
            with suppress(DiffsimError):
                row[:] = problem.records(point[None])[0]
        return rows


def residuals_by_run(runs: Sequence[Run], record: Array) -> dict[str, Array]:
    """Measured minus predicted by name of the run, (num_samples, num_channels) each.

    Args:
        runs: Runs whose samples the record holds, in this order.
        record: Predicted samples of all runs, (N,) [unit of the channel].
    """
    edges = np.cumsum([run.measured.size for run in runs])[:-1]
    parts = np.split(record, edges)
    return {
        r.name: r.measured - p.reshape(r.measured.shape) for r, p in zip(runs, parts, strict=True)
    }
