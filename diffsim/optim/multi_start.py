"""Many starts, of which the best few are improved (multi-start, thesis 4.1.6)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.runs import run_each
from diffsim.optim.evaluation import (
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

_Found = TypeVar("_Found")


@checked(kinds_only=True)
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


@checked
def uniform_points(bounds: Bounds, count: int, seed: int = 0) -> Array:
    """Random points between finite bounds, (count, n); more of them begin with the same ones."""
    lower, upper = (np.array(b, dtype=np.float64) for b in bounds)
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise ValueError("random starts need finite bounds")
    share = np.random.default_rng(seed).uniform(size=(count, len(lower)))
    return np.clip(lower + share * (upper - lower), lower, upper)


@checked
def screen(
    value: ValueOnly,
    points: Iterable[Array],
    *,
    log: Log | None = None,
    name: str = "starts",
    failures: tuple[type[Exception], ...] = (DiffsimError,),
    callback: Callback | None = None,
    executor: Executor | None = None,
) -> tuple[Evaluation, ...]:
    """Evaluate an objective at given points.

    Args:
        value: Function of points (n,) that returns the value; the gradient is not needed.
        points: Points to be evaluated, (n,) each.
        log: Log in which evaluations are kept; a point that it holds is not evaluated again.
        name: Name of the list in the log.
        failures: Exceptions that make a point infinitely bad, besides values that are not finite.
        callback: Called after every evaluation; screening ends where it returns True.
        executor: Executor of the evaluations, for which ``value`` must be picklable; None: one
            after another.

    Returns:
        The evaluations, in the order of the points.
    """
    xs = [np.array(point, dtype=np.float64) for point in points]
    kept = [None if log is None else log.find(name, x) for x in xs]
    made: dict[int, Evaluation] = {}

    def ended(k: int, evaluation: Evaluation, replayed: bool) -> None:
        made[k] = evaluation
        if callback is not None:
            best = min(e.value for e in made.values())
            progress = Progress(
                count=len(made), evaluation=evaluation, best=best, replayed=replayed
            )
            if callback(progress) is True:
                raise _Enough

    def keep(i: int, evaluation: Evaluation) -> None:
        if log is not None:
            evaluation = evaluation_of(log.append(name, entry_of(evaluation)))
        ended(missing[i], evaluation, False)

    missing = [k for k, entry in enumerate(kept) if entry is None]
    caught = (*failures, NotFiniteError)
    try:
        for k, entry in enumerate(kept):
            if entry is not None:
                ended(k, evaluation_of(entry), True)
        run_each(partial(_try_point, value, caught), [xs[k] for k in missing], executor, done=keep)
    except _Enough:
        pass
    return tuple(made[k] for k in sorted(made))


class _Enough(Exception):
    """A callback ended the screening."""


def _try_point(value: ValueOnly, caught: tuple[type[Exception], ...], x: Array) -> Evaluation:
    try:
        return evaluate(value, x)
    except caught as error:
        return failed(x, error)


@checked
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
    executor: Executor | None = None,
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
        executor: Executor of starts and descents, for which the objective must be picklable; None:
            one after another. The result is the same; a descent is in the log when it has ended.

    Returns:
        ``MultiStart``.

    Raises:
        DiffsimError: none of the starts can be evaluated.
        ValueError: a callback with an executor: descents do not run where it could be called.
    """
    require_number("count", count, at_least=1)
    require_number("keep", keep, at_least=1)
    if executor is not None and callback is not None:
        raise ValueError(
            "callback cannot be called while descents run elsewhere; leave out callback or executor"
        )
    options = Options() if options is None else options
    failures = (options.wall or Wall(failures=())).failures
    points = uniform_points(bounds, count, seed)
    starts = screen(value or objective, points, log=log, failures=failures, executor=executor)
    possible = [e for e in starts if not e.failure]
    if not possible:
        raise DiffsimError(
            f"none of {count} random starts can be evaluated; the last one: {starts[-1].failure}"
        )
    best = sorted(possible, key=lambda e: e.value)[:keep]
    named = [(f"descent {k}", e.x) for k, e in enumerate(best, start=1)]
    descend = partial(minimize, objective, bounds=bounds, options=options, callback=callback)
    return MultiStart(starts=starts, descents=tuple(from_each(descend, named, log, executor)))


def from_each(
    descend: Callable[..., _Found],
    named: Sequence[tuple[str, Any]],
    log: Log | None,
    executor: Executor | None,
) -> list[_Found]:
    """A descent from each start; in a worker it has a log of its own, which is taken at its end.

    Args:
        descend: Takes a start, ``log`` and ``name``; picklable where there is an executor.
        named: Names of the descents in the log, and their starts.
        log: Log of the search; None: none is kept.
        executor: Executor of the descents; None: one after another.
    """
    if executor is None:
        return [descend(x, log=log, name=name) for name, x in named]
    whole = Log() if log is None else log

    def taken(k: int, answer: tuple[_Found, Log]) -> None:
        whole.take(named[k][0], answer[1])

    asked = [(name, x, whole.part(name)) for name, x in named]
    answers = run_each(partial(_in_worker, descend), asked, executor, done=taken)
    return [found for found, _ in answers]


def _in_worker(descend: Callable[..., _Found], asked: tuple[str, Any, Log]) -> tuple[_Found, Log]:
    name, x, log = asked
    return descend(x, log=log, name=name), log
