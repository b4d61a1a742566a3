"""Many starts, of which the best few are improved (multi-start, thesis 4.1.6)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from diffsim.core.check import require_number
from diffsim.core.errors import DiffsimError
from diffsim.optim.evaluation import (
    Array,
    Callback,
    Evaluation,
    NotFiniteError,
    Objective,
    Progress,
    ValueOnly,
    evaluate,
    failed,
)
from diffsim.optim.log import Log, entry_of, evaluation_of
from diffsim.optim.minimize import Bounds, minimize
from diffsim.optim.options import Options, Wall
from diffsim.optim.result import Result


@dataclass(frozen=True, eq=False, kw_only=True)
class MultiStart:
    """Result of a search from many starts.

    Attributes:
        starts: Evaluations of all starts, in the order in which they were drawn.
        descents: Results from the best starts, the best start first.
    """

    starts: tuple[Evaluation, ...]
    descents: tuple[Result, ...]

    @property
    def result(self) -> Result:
        """The result of the least value."""
        return min(self.descents, key=lambda r: r.value)


def uniform_points(bounds: Bounds, count: int, seed: int = 0) -> Array:
    """Random points between finite bounds, (count, n); more of them begin with the same ones."""
    lower, upper = (np.array(b, dtype=np.float64) for b in bounds)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise ValueError("random starts need finite bounds")
    share = np.random.default_rng(seed).uniform(size=(count, len(lower)))
    return np.clip(lower + share * (upper - lower), lower, upper)


def screen(
    value: ValueOnly,
    points: Iterable[Array],
    *,
    log: Log | None = None,
    name: str = "starts",
    failures: tuple[type[Exception], ...] = (DiffsimError,),
    callback: Callback | None = None,
) -> tuple[Evaluation, ...]:
    """Evaluate an objective at given points.

    Args:
        value: Function of points (n,) that returns the value; the gradient is not needed.
        points: Points to be evaluated, (n,) each.
        log: Log in which evaluations are kept; a point that it holds is not evaluated again.
        name: Name of the list in the log.
        failures: Exceptions that make a point infinitely bad, besides values that are not finite.
        callback: Called after every evaluation; screening ends where it returns True.

    Returns:
        The evaluations, in the order of the points.
    """
    made: list[Evaluation] = []
    caught: tuple[type[Exception], ...] = (*failures, NotFiniteError)
    best = np.inf
    for point in points:
        x = np.array(point, dtype=np.float64)
        kept = None if log is None else log.find(name, x)
        if kept is None:
            try:
                evaluation = evaluate(value, x)
            except caught as error:
                evaluation = failed(x, error)
            if log is not None:
                evaluation = evaluation_of(log.append(name, entry_of(evaluation)))
        else:
            evaluation = evaluation_of(kept)
        made.append(evaluation)
        best = min(best, evaluation.value)
        if callback is not None:
            progress = Progress(
                count=len(made), evaluation=evaluation, best=best, replayed=kept is not None
            )
            if callback(progress) is True:
                break
    return tuple(made)


def multi_start(
    objective: Objective,
    bounds: Bounds,
    options: Options | None = None,
    *,
    count: int,
    keep: int = 1,
    seed: int = 0,
    value: ValueOnly | None = None,
    log: Log | None = None,
    callback: Callback | None = None,
) -> MultiStart:
    """Draw random starts between the bounds, and descend from the best of them.

    Args:
        objective: Deterministic function of points (n,) that returns value and gradient, see
            ``minimize``.
        bounds: Lower and upper, (n,) each, finite.
        options: Budget and tolerances of each descent.
        count: Number of starts to draw.
        keep: Number of starts to descend from, the best first; fewer if fewer can be evaluated.
        seed: Seed of the draws.
        value: The objective without its gradient, for the starts; ``objective`` itself if None.
        log: Lists "starts" and "descent 1", "descent 2", ...
        callback: Function called after every evaluation of a descent; where it returns True, that
            descent ends.

    Returns:
        ``MultiStart``.

    Raises:
        DiffsimError: none of the starts can be evaluated.
    """
    require_number("count", count, at_least=1)
    require_number("keep", keep, at_least=1)
    options = Options() if options is None else options
    failures = (options.wall or Wall(failures=())).failures
    points = uniform_points(bounds, count, seed)
    starts = screen(value or objective, points, log=log, failures=failures)
    possible = [e for e in starts if not e.failure]
    if not possible:
        raise DiffsimError(
            f"none of {count} random starts can be evaluated; the last one: {starts[-1].failure}"
        )
    best = sorted(possible, key=lambda e: e.value)[:keep]
    descents = tuple(
        minimize(objective, e.x, bounds, options, log=log, name=f"descent {k}", callback=callback)
        for k, e in enumerate(best, start=1)
    )
    return MultiStart(starts=starts, descents=descents)
