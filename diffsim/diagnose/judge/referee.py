"""What names are held against: select runs, else fit runs left out one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Run
from diffsim.diagnose.judge.gain import Gain, compared, held_out_residuals
from diffsim.diagnose.judge.left_out import (
    Folds,
    Repeats,
    folds_of,
    left_out_residual,
)
from diffsim.identify import Fit, Problem

Array = NDArray[np.float64]


class Referee(Protocol):
    """Runs, or parts of runs, that a fit has not seen.

    Attributes:
        words: What they are, as the report says it.
        runs: Runs that residuals belong to.
    """

    @property
    def words(self) -> str: ...

    @property
    def runs(self) -> Sequence[Run]: ...

    def residuals(self, fit: Fit) -> Sequence[Array]:
        """(num_valid,) whitened residuals by run."""
        ...


@dataclass(eq=False)
class SelectRuns:
    """Runs with use: select, to which nothing is fitted but what is their own.

    Args:
        runs: These runs.
    """

    runs: Sequence[Run]
    words: str = "runs with use: select"
    _kept: dict[Fit, Sequence[Array]] = field(default_factory=dict, repr=False)

    def residuals(self, fit: Fit) -> Sequence[Array]:
        """(num_valid,) whitened residuals by run."""
        if fit not in self._kept:
            self._kept[fit] = held_out_residuals(fit, self.runs)
        return self._kept[fit]


@dataclass(eq=False)
class LeftOut:
    """Parts of the fit runs, each predicted by a fit without it.

    Args:
        problem: Problem with the runs that are fitted.
        folds: Parts that are left out.
    """

    problem: Problem
    folds: Folds
    repeats: Repeats = field(default_factory=Repeats)
    _kept: dict[Fit, Sequence[Array]] = field(default_factory=dict, repr=False)

    @property
    def words(self) -> str:
        """How parts were left out."""
        return self.folds.words

    @property
    def runs(self) -> Sequence[Run]:
        """Runs that are fitted."""
        return self.problem.runs

    def residuals(self, fit: Fit) -> Sequence[Array]:
        """(num_valid,) whitened residuals by run."""
        if fit not in self._kept:
            rows = left_out_residual(fit, self.folds, self.repeats)
            self._kept[fit] = fit.problem.by_run(rows)
        return self._kept[fit]


def referee_of(plain: Fit, select: Sequence[Run]) -> Referee | None:
    """Select runs if there are any, else fit runs left out; None where they are too few.

    Args:
        plain: Fit of the plain model.
        select: Runs with use: select.
    """
    if select:
        return SelectRuns(select)
    folds = folds_of(plain)
    return None if folds is None else LeftOut(plain.problem, folds)


def gain_over(referee: Referee, without: Fit, best: Fit, seed: int) -> Gain:
    """Gain of a fit over another on what neither has seen."""
    before, after = referee.residuals(without), referee.residuals(best)
    return compared(referee.runs, without, before, after, seed=seed)
