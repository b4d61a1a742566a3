"""The search: scipy's L-BFGS-B, driven within a budget, past failures, from a log."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.numbers import to_numpy
from diffsim.core.values import as_array
from diffsim.optim.evaluation import (
    Callback,
    Evaluation,
    NotFiniteError,
    Objective,
    Progress,
    evaluate,
    failed,
)
from diffsim.optim.log import Log, entry_of, evaluation_of
from diffsim.optim.options import Options, Wall
from diffsim.optim.result import Ended, Result

Bounds = tuple[Array, Array]
_SCIPY_ENDED: dict[int, Ended] = {0: "converged", 1: "budget", 2: "failed"}


@checked
def minimize(
    objective: Objective,
    start: Array,
    bounds: Bounds | None = None,
    options: Options | None = None,
    *,
    log: Log | None = None,
    name: str = "evaluations",
    callback: Callback | None = None,
) -> Result:
    """Minimize a function of bounded variables by L-BFGS-B (Byrd et al. 1995, scipy's version).

    L-BFGS-B is deterministic: run again, it asks for the same points in the same order. Points that
    the log holds are answered from there, so that an interrupted search, started again, ends with
    the bits of one that was not interrupted.

    Args:
        objective: Deterministic function of points (n,) that returns value and gradient (n,), see
            ``Sample``.
        start: Start point, (n,); moved to the nearest point within the bounds.
        bounds: Lower and upper bounds, (n,) each, infinite where there is none; None: no bounds.
        options: Budget, tolerances, failure wall and unit.
        log: Log in which every evaluation is kept and from which it is replayed; None: nothing is
            kept.
        name: Name of the list in the log.
        callback: Called after every evaluation, replayed ones included; ends the search by True.

    Returns:
        ``Result``; look at ``ended``.

    Raises:
        ValueError: start or bounds do not fit together.
        Exception: what the objective raised at the start, or what does not count as a failure.
    """
    options = Options() if options is None else options
    start, bounds = _check_start(start, bounds)
    search = _Search(objective, options, log, name, callback)
    accepted = [start]
    tolerances, budget = options.tolerances, options.budget
    maxfun = budget.evaluations if budget.finish_line_search else None
    try:
        solution = optimize.minimize(
            search,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=None if bounds is None else list(zip(*bounds, strict=True)),
            callback=lambda xk: accepted.append(xk),
            options={
                "ftol": tolerances.ftol,
                "gtol": tolerances.gtol,
                "maxls": tolerances.line_search,
                "maxcor": tolerances.memory,
                "maxfun": maxfun or sys.maxsize,
                "maxiter": budget.iterations or sys.maxsize,
            },
        )
    except _Stop as stop:
        ended, message = stop.ended, stop.message
    else:
        accepted.append(solution.x)
        ended, message = _SCIPY_ENDED[int(solution.status)], str(solution.message)
    history = tuple(search.history)
    final = next(e for e in reversed(history) if np.array_equal(e.x, accepted[-1]))
    return Result(history=history, final=final, ended=ended, message=message)


class _Stop(Exception):
    """Ends scipy's loop from within an evaluation."""

    def __init__(self, ended: Ended, message: str):
        super().__init__(message)
        self.ended, self.message = ended, message


@dataclass(eq=False)
class _Search:
    """The function that scipy sees: counted, logged, in units, with a wall."""

    objective: Objective
    options: Options
    log: Log | None
    name: str
    callback: Callback | None
    history: list[Evaluation] = field(default_factory=list)
    best: float = np.inf
    unit: float = 1.0

    def __call__(self, x: Array) -> tuple[float, Array]:
        budget = self.options.budget
        if not budget.finish_line_search and len(self.history) == budget.evaluations:
            raise _Stop("budget", f"limit of {budget.evaluations} evaluations")
        evaluation, replayed = self._evaluation(x)
        if not self.history:
            self.unit = self.options.unit or abs(evaluation.value) or 1.0
        self.history.append(evaluation)
        self.best = min(self.best, evaluation.value)
        if self.callback is not None:
            progress = Progress(
                count=len(self.history), evaluation=evaluation, best=self.best, replayed=replayed
            )
            if self.callback(progress) is True:
                raise _Stop("callback", f"callback after {progress.count} evaluations")
        if evaluation.gradient is None:
            return self._wall(), np.zeros_like(x)
        return evaluation.value / self.unit, evaluation.gradient / self.unit

    def _wall(self) -> float:
        assert self.options.wall is not None  # without a wall no failed evaluation is kept
        return self.options.wall.value(self.history[0].value / self.unit, self.best / self.unit)

    def _evaluation(self, x: Array) -> tuple[Evaluation, bool]:
        """The evaluation at x, and whether the log had it."""
        kept = None if self.log is None else self.log.find(self.name, x)
        if kept is not None and self._is_usable(kept["failure"]):
            return evaluation_of(kept), True
        made = self._evaluate(x)
        if self.log is not None:
            made = evaluation_of(self.log.append(self.name, entry_of(made)))
        return made, False

    def _is_usable(self, failure: str) -> bool:
        """A failure is tried again where it would end the search: its exception is not kept."""
        return not failure or (bool(self.history) and self.options.wall is not None)

    def _evaluate(self, x: Array) -> Evaluation:
        try:
            made = evaluate(self.objective, x)
        except _failures(self.options.wall) as error:
            if not self.history:
                raise  # the start must be possible
            return failed(x, error)
        if made.gradient is None:
            raise ValueError("the objective must return its gradient, too")
        return made


def _failures(wall: Wall | None) -> tuple[type[Exception], ...]:
    return () if wall is None else (*wall.failures, NotFiniteError)


def _check_start(start: Array, bounds: Bounds | None) -> tuple[Array, Bounds | None]:
    start = to_numpy("start", as_array("start", start)).astype(np.float64)
    if start.ndim != 1 or not len(start) or not np.isfinite(start).all():
        raise ValueError(f"start must be a vector of finite numbers, got {start}")
    if bounds is None:
        return start, None
    if len(bounds) != 2:
        raise ValueError(f"bounds must be lower and upper ones, got {len(bounds)} entries")
    lower, upper = (to_numpy("bounds", as_array("bounds", b)).astype(np.float64) for b in bounds)
    if not lower.shape == upper.shape == start.shape:
        raise ValueError(
            f"bounds must have the start's shape {start.shape}, got {lower.shape}, {upper.shape}"
        )
    if not (lower <= upper).all():
        raise ValueError(f"lower bounds {lower} must not lie above the upper ones {upper}")
    return np.clip(start, lower, upper), (lower, upper)
