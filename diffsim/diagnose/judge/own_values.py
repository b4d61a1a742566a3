"""What is fitted to a run whatever it is used for: values that are its own ("offset@run")."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch
from scipy import optimize

from diffsim.core.arrays import Array
from diffsim.core.figures import figure
from diffsim.core.units import after_number, small_scale
from diffsim.data.study import Run
from diffsim.identify import Problem
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.effort import FIT_RTOL

_FAR = 1.5  # misfit per sample of a run's own values, from which their slopes are taken anew
_STRAIGHT = 0.02  # share of it that this must promise
_ENOUGH = 0.1 * FIT_RTOL  # promise of a step that is not simulated: slopes may be a little wrong
UNTOLD_PULL = 0.01  # prior sd; nearer to its prior nothing was said of a value
FAR_OFF = 3.0  # prior sd from which on a value that was fitted to a run is no usual one


@dataclass(frozen=True)
class OwnRow:
    """A value that was fitted to one run that nothing else was fitted to.

    Attributes:
        run: Name of the run.
        name: Name of the parameter, such as "offset@run_9".
        unit: SI unit, "-" if none.
        value: Where it ended, in ``unit``.
        prior_value, prior_sd: What the study states of it, in ``unit``.
        pull: How far it ended from that [prior sd], with sign.
    """

    run: str
    name: str
    unit: str
    value: float
    prior_value: float
    prior_sd: float
    pull: float

    @property
    def is_told(self) -> bool:
        """Whether the run says anything of it: a shape of a cause that is absent is not."""
        return abs(self.pull) > UNTOLD_PULL

    @property
    def words(self) -> str:
        """The row in a clause."""
        values = (self.value, self.prior_value, self.prior_sd)
        shown, times = small_scale(self.unit, values)
        value, prior, sd = (times * v for v in values)
        unit = after_number(shown)
        name = self.name.partition("@")[0].rstrip(".").replace("_", " ")
        stated = f"{figure(prior, 4)} +- {figure(sd, 2)}{unit}"
        return (
            f"{name} {figure(value, 4)}{unit}, stated {stated}: {figure(abs(self.pull), 2)} sd off"
        )


class Frozen(Protocol):
    """A problem at coordinates that are not fitted any more; a ``Fit`` is one."""

    @property
    def problem(self) -> Problem: ...

    @property
    def x(self) -> Array: ...


def held_out_point(fit: Frozen, run: Run, unmet: Collection[str] | None = None) -> Array:
    """A fit's coordinates with what is a run's own ("offset@run") fitted to it, (n,).

    Gain, errors, page and recording ask for it: the problem keeps it, nothing is simulated twice.

    Args:
        fit: Model, noise and coordinates, which stay.
        run: Run that was not fitted.
        unmet: Parameters that no fitted run has, as of ``own_names``; None: those of the problem.
    """
    known = tuple(unmet_by(fit.problem) if unmet is None else unmet)
    found: Array = fit.problem.memo(
        ("held_out_point", run, np.asarray(fit.x).tobytes(), known),
        lambda: own_point(replace(fit.problem, runs=(run,)), fit.x, run, unmet=known),
    )
    return found.copy()


def unmet_by(problem: Problem) -> tuple[str, ...]:
    """Base parameters of a rotor, a material, ... that no run of the problem has."""
    known = {n for run in problem.runs for n in problem.names if is_of_fact(n, run)}
    return tuple(p.name for p in problem.model.base if "[" in p.name and p.name not in known)


def is_of_fact(name: str, run: Run) -> bool:
    """Whether a parameter, as "gain[rotor=A]", is that of a fact of the run."""
    return any(name.endswith(f"[{fact}={value}]") for fact, value in run.setup.items())


def own_names(names: Sequence[str], run: Run, unmet: Collection[str] = ()) -> tuple[str, ...]:
    """Parameters that are fitted to a run whatever it is used for.

    Args:
        names: Names of all coordinates.
        run: Run that they belong to.
        unmet: Parameters that no fitted run has; those of this run's facts are its own.
    """
    at_run = f"@{run.name}"
    return tuple(n for n in names if n.endswith(at_run) or (n in unmet and is_of_fact(n, run)))


def own_rows(problem: Problem, x: Array, run: Run, names: Collection[str]) -> tuple[OwnRow, ...]:
    """What was fitted to a run alone, beside what was known of it before; the farthest off first.

    Args:
        problem: Model and noise.
        x: Standardized coordinates with the run's own values, (n,).
        run: The run.
        names: Its own names, as of ``own_names``.
    """
    rows = []
    for p, pull in zip(problem.model.base, x.tolist(), strict=False):
        if p.name in names:
            at = float(p.value_at(torch.tensor(pull, dtype=torch.float64)))
            sd = p.sd * p.value if p.log else p.sd
            rows.append(OwnRow(run.name, p.name, p.unit, at, p.value, sd, pull))
    sizes = problem.size_units * problem.scaled(x)[problem.num_base :]
    more = zip(problem.names[problem.num_base :], problem.owners, sizes, strict=True)
    for k, (name, (effect, _), size) in enumerate(more):
        if name in names:
            sd, pull = PRIOR_WIDTH * effect.typical, float(x[problem.num_base + k])
            rows.append(OwnRow(run.name, name, effect.unit, float(size), 0.0, sd, pull))
    return tuple(sorted(rows, key=lambda row: -abs(row.pull)))


def own_point(
    problem: Problem,
    x: Array,
    run: Run,
    slopes: Array | None = None,
    unmet: Collection[str] = (),
) -> Array:
    """Coordinates with the values of one run ("offset@run") fitted to it, all others as given.

    Args:
        problem: Model and noise, with this run only.
        x: Standardized coordinates, (n,); the run's own are fitted from the middle of their prior.
        run: Run that they belong to.
        slopes: Whitened slopes of the run's rows, (num_valid, n); None: simulated.
        unmet: Parameters that no fitted run has, as of ``own_names``.
    """
    names = set(own_names(problem.names, run, unmet))
    own = [i for i, n in enumerate(problem.names) if n in names]
    if not own:
        return x
    alone = _Alone(problem, x, own)
    # what is stated per run acts almost linearly: slopes of its start serve for all steps; a size
    # is no straight function of its coordinate
    is_linear = not names & set(unmet) and max(own) < problem.num_base
    start = np.zeros(len(own))
    if not is_linear:
        return alone.full(alone.fitted(start, alone.columns))
    held = alone.columns(start) if slopes is None else -slopes[:, own]
    part = alone.fitted(start, lambda _: held)
    if slopes is None and alone.is_left_short(part):
        part = alone.fitted(part, alone.columns)  # a ball that begins to roll: no straight function
    return alone.full(part)


class _Alone:
    """Values of one run, all others held.

    Args:
        problem: Model and noise, with this run only.
        x: Standardized coordinates, (n,).
        own: Indices of the run's own.
    """

    def __init__(self, problem: Problem, x: Array, own: list[int]):
        self._problem, self._x, self._own = problem, x, own
        self._bounds = tuple(b[own] for b in problem.bounds)
        # where slopes of the start are given up, they are asked for twice
        self._slopes = lru_cache(maxsize=1)(self._simulate_slopes)

    def full(self, part: Array) -> Array:
        """All coordinates, (n,)."""
        point = self._x.copy()
        point[self._own] = part
        return point

    def columns(self, part: Array) -> Array:
        """Slopes of the residual, (num_valid, num_own)."""
        return self._slopes(part.tobytes())

    def fitted(self, start: Array, columns: Callable[[Array], Array]) -> Array:
        """The least misfit from a start, (num_own,)."""
        low, high = self._bounds
        is_bounded = np.isfinite(low).any() or np.isfinite(high).any()
        descent = _Descent(lambda part: self._problem.residual(self.full(part)), columns)
        try:
            found = optimize.least_squares(
                descent.rest,
                np.clip(start, low, high),
                jac=descent.slopes,
                bounds=(low, high),
                method="dogbox" if is_bounded else "trf",
                ftol=FIT_RTOL,
            )
        except _EnoughError:
            return descent.best
        return np.asarray(found.x)

    def is_left_short(self, part: Array) -> bool:
        """Whether the misfit is large, and slopes taken anew promise to lower it."""
        left = self._problem.residual(self.full(part))
        if left @ left <= _FAR * len(left):
            return False
        return _promise(left, self.columns(part), part) > _STRAIGHT

    def _simulate_slopes(self, key: bytes) -> Array:
        point = self.full(np.frombuffer(key, dtype=np.float64))
        return -np.asarray(self._problem.linearize(point, only=self._own)[1][:, self._own])


class _EnoughError(Exception):
    """The next step promises less than fits are exact to."""


class _Descent:
    """What a least-squares solver asks for, until a step promises too little to be simulated.

    A solver asks what a step gained. Where slopes are a little wrong it tries ever shorter steps
    near the end, none of which gains anything; what they promise says as much beforehand.

    Args:
        residual: Whitened residual of the run at its values.
        columns: Its slopes.

    Attributes:
        best: Values of the least misfit so far, (num_own,).
    """

    def __init__(self, residual: Callable[[Array], Array], columns: Callable[[Array], Array]):
        self._residual, self._columns = residual, columns
        self._least = np.inf
        self.best = self._left = self._slopes = np.zeros(0)
        self._has_failed = False  # the last step; slopes are those of the best values then

    def rest(self, part: Array) -> Array:
        """Residual with the prior below, (num_valid + num_own,).

        Raises:
            _EnoughError: a step from the best values failed, and this shorter one promises too
                little.
        """
        if self._has_failed:
            after = self._left + self._slopes @ (part - self.best)
            if self._least - float(after @ after) < _ENOUGH * self._least:
                raise _EnoughError
        rest = np.concatenate([self._residual(part), part])
        cost = float(rest @ rest)
        self._has_failed = not cost < self._least
        if not self._has_failed:
            self._least, self.best, self._left = cost, part.copy(), rest
        return rest

    def slopes(self, part: Array) -> Array:
        """Their slopes, (num_valid + num_own, num_own)."""
        self._slopes = np.vstack([self._columns(part), np.eye(len(part))])
        return self._slopes


def _promise(left: Array, columns: Array, part: Array) -> float:
    """Share of the misfit that another step would remove, were all straight."""
    rest, slopes = np.concatenate([left, part]), np.vstack([columns, np.eye(len(part))])
    step = np.linalg.lstsq(slopes, -rest, rcond=None)[0]
    after = rest + slopes @ step
    return 1.0 - float(after @ after) / float(rest @ rest)


def own_words(rows: Sequence[OwnRow]) -> list[str]:
    """Values that ended far from what is stated of them, a sentence for each parameter.

    Args:
        rows: Values of all runs.
    """
    far: dict[str, list[OwnRow]] = {}
    for row in rows:
        if abs(row.pull) > FAR_OFF:
            far.setdefault(row.name.partition("@")[0], []).append(row)
    return [
        f"Run {own[0].run} was fitted far from what the study states: {own[0].words}."
        if len(own) == 1
        else _many_words(own)
        for own in far.values()
    ]


def _many_words(own: Sequence[OwnRow]) -> str:
    """One parameter of several runs."""
    ends = [row.value for row in own]
    stated_ends = (*ends, own[0].prior_value, own[0].prior_sd)
    shown, times = small_scale(own[0].unit, stated_ends)
    low, high = (figure(times * v, 2) for v in (min(ends), max(ends)))
    name, unit = own[0].name.partition("@")[0].rstrip(".").replace("_", " "), after_number(shown)
    stated = f"{figure(times * own[0].prior_value)} +- {figure(times * own[0].prior_sd, 2)}{unit}"
    return (
        f"{len(own)} runs were fitted far from what the study states: "
        f"{name} {low} to {high}{unit}, stated {stated}."
    )
