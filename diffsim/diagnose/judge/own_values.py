"""What is fitted to a run whatever it is used for: values that are its own ("offset@run")."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.core.figures import figure
from diffsim.core.units import after_number, small_scale
from diffsim.data.study import Run
from diffsim.diagnose.search.gauss_newton import MAX_RADIUS, MAX_STEPS
from diffsim.diagnose.search.optimum import quadratic_optimum
from diffsim.identify import Problem
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.effort import FIT_NATS, FIT_RTOL
from diffsim.identify.ranges import SURE_SD

POOR = 0.25  # share of the promised gain, below which steps get shorter
UNTOLD_PULL = 0.01  # prior sd; nearer to its prior nothing was said of a value

_FIRST_NOISE = re.compile(r"first (.+) noise")  # of what a run's start is read from
#: A cause at a place whose name holds a capital letter: no word, but a name of the user's file.
_AT_NAMED = re.compile(r"([a-z\d_ ]+)[_ ](at|of|from)[_ ]((?!all_|every_)[a-z\d_]*[A-Z][\w.]*)")


def words_of(name: str) -> str:
    """A code name in plain words: "drag[frame=A]" is "drag (frame A)", "joint.J2.damping" of an
    MJCF is "damping of J2", "friction_at_FR_calf" is "friction at FR_calf": a part as its file
    names it."""
    stem, _, run = name.partition("@")
    stem, _, fact = stem.partition("[")
    part, _, quantity = stem.partition(".")[2].rpartition(".")
    words = (quantity if part else stem).replace("_", " ").replace(".", " ")
    if first := _FIRST_NOISE.fullmatch(words):
        words = f"noise of the first reading of {first[1]}"
    if named := _AT_NAMED.fullmatch(stem):
        place = named[3].replace(".", " ").replace("_and_", " and ")
        words = f"{named[1].replace('_', ' ')} {named[2]} {place}"
    elif part:
        words += f" of {part}"
    if fact:
        words += f" ({fact.rstrip(']').replace('=', ' ')})"
    return f"{words} {'in' if part else 'of'} {run}" if run else words


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
    def plain_name(self) -> str:
        """Its name without the run."""
        return words_of(self.name.partition("@")[0].rstrip("."))

    @property
    def farthest(self) -> tuple[float, str]:
        """How far it ended from what is stated [prior sd], and what it is."""
        return abs(self.pull), self.plain_name

    @property
    def words(self) -> str:
        """The row in a clause."""
        read = self.as_read()
        unit = after_number(read.unit)
        stated = f"{figure(read.prior_value, 4)} +- {figure(read.prior_sd, 2)}{unit}"
        return (
            f"{self.plain_name} {figure(read.value, 4)}{unit}, stated {stated}: "
            f"{figure(abs(self.pull), 2)} sd off"
        )

    def as_read(self) -> OwnRow:
        """The same in the unit in which it is read."""
        unit, times = small_scale(self.unit, (self.value, self.prior_value, self.prior_sd))
        value, prior, sd = (times * v for v in (self.value, self.prior_value, self.prior_sd))
        return replace(self, unit=unit, value=value, prior_value=prior, prior_sd=sd)


class Frozen(Protocol):
    """A problem at coordinates that are not fitted any more; a ``Fit`` is one."""

    @property
    def problem(self) -> Problem: ...

    @property
    def x(self) -> Array: ...


def held_out_point(
    fit: Frozen, run: Run, unmet: Collection[str] | None = None
) -> tuple[Array, Array | None]:
    """A fit's coordinates with what is a run's own ("offset@run") fitted to it, and the residual
    there, as of ``own_point``.

    Gain, errors, page and recording ask for it: the problem keeps it, nothing is simulated twice.

    Args:
        fit: Model, noise and coordinates, which stay.
        run: Run that was not fitted.
        unmet: Parameters that no fitted run has, as of ``own_names``; None: those of the problem.
    """
    known = tuple(unmet_by(fit.problem) if unmet is None else unmet)
    x, left = fit.problem.memo(
        ("held_out_point", run, np.asarray(fit.x).tobytes(), known),
        lambda: own_point(replace(fit.problem, runs=(run,)), fit.x, run, unmet=known),
    )
    return x.copy(), left


def held_out_residual(fit: Frozen, run: Run) -> Array:
    """(num_valid,) whitened residual with the fit's parameters, nuisances of this run refitted."""
    x, left = held_out_point(fit, run)
    return replace(fit.problem, runs=(run,)).residual(x) if left is None else left.copy()


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
        unmet: Parameters that no fitted run has; those of this run's facts are its own.
    """
    at_run = f"@{run.name}"
    return tuple(n for n in names if n.endswith(at_run) or (n in unmet and is_of_fact(n, run)))


def own_rows(problem: Problem, x: Array, run: Run, names: Collection[str]) -> tuple[OwnRow, ...]:
    """What was fitted to a run alone, beside what was known of it before; the farthest off first.

    Args:
        problem: Model and noise.
        x: Standardized coordinates with the run's own values, (n,).
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
) -> tuple[Array, Array | None]:
    """Coordinates with the values of one run ("offset@run") fitted to it, all others as given; and
    the whitened residual there, (num_valid,), None where the run has none of its own.

    Args:
        problem: Model and noise, with this run only.
        x: Standardized coordinates, (n,); the run's own are fitted from the middle of their prior.
        slopes: Whitened slopes of the run's rows, (num_valid, n); None: simulated at every step.
        unmet: Parameters that no fitted run has, as of ``own_names``.
    """
    names = set(own_names(problem.names, run, unmet))
    own = [i for i, n in enumerate(problem.names) if n in names]
    if not own:
        return x, None
    # what is stated per run acts almost linearly: slopes of the fit serve for all steps; a size is
    # no straight function of its coordinate
    is_straight = not names & set(unmet) and max(own) < problem.num_base
    held = slopes[:, own] if slopes is not None and is_straight else None

    def full(part: Array) -> Array:
        """All coordinates, (n,)."""
        point = x.copy()
        point[own] = part
        return point

    def linearized(part: Array, left: Array | None) -> tuple[Array, Array]:
        """Residual and slopes, (num_valid,) and (num_valid, num_own); ``left``: it is known."""
        if held is None:
            return problem.linearize(full(part), only=own)
        return problem.residual(full(part)) if left is None else left, held

    low, high = (bound[own] for bound in problem.bounds)
    first = np.clip(np.zeros(len(own)), low, high)
    found, left = _fit_own(lambda p: problem.residual(full(p)), linearized, first, low, high)
    return full(found), left


def _fit_own(
    residual: Callable[[Array], Array],
    linearized: Callable[[Array, Array | None], tuple[Array, Array]],
    at: Array,
    low: Array,
    high: Array,
) -> tuple[Array, Array]:
    """argmin |r(v)|^2 + |v|^2 within bounds, (num_own,), and r there: Gauss-Newton in a box, at
    whose sides the first step seldom ends; slopes are simulated again only where they were wrong.

    Args:
        residual: r at some values.
        linearized: r and -dr/dv at some values, and r there where it is known.
        at: Where it begins.
        low, high: Bounds.
    """
    left, slopes = linearized(at, None)
    radius = MAX_RADIUS
    for _ in range(MAX_STEPS):
        box = np.maximum(low, at - radius), np.minimum(high, at + radius)
        gram, right = slopes.T @ slopes + np.eye(len(at)), slopes.T @ (left + slopes @ at)
        end = quadratic_optimum(gram, right, *box)
        cost, least = _cost(left, at), max(2.0 * FIT_NATS, FIT_RTOL * _cost(left, at))
        promised = cost - _cost(left - slopes @ (end - at), end)
        there, longest = _try_at(residual, end), float(np.abs(end - at).max())
        gained = -math.inf if there is None else cost - _cost(there, end)
        if there is not None and gained > 0.0:
            at, left = end, there
            if promised >= least and abs(gained - promised) >= least:
                left, slopes = linearized(at, left)
        if promised < least:
            break
        if gained < POOR * promised:
            radius = POOR * longest
        elif longest > 0.9 * radius:
            radius *= 2.0
    return at, left


def _cost(left: Array, at: Array) -> float:
    """Squares of a residual and of coordinates."""
    return float(left @ left + at @ at)


def _try_at(residual: Callable[[Array], Array], at: Array) -> Array | None:
    """The residual at some values; None where they are too far to be simulated."""
    try:
        left = residual(at)
    except DiffsimError:
        return None
    with np.errstate(over="ignore"):
        return left if np.isfinite(left @ left) else None


def own_words(rows: Sequence[OwnRow]) -> list[str]:
    """Values that ended far from what is stated of them, a sentence for each parameter.

    Args:
        rows: Values of all runs.
    """
    far: dict[str, list[OwnRow]] = {}
    for row in rows:
        if abs(row.pull) > SURE_SD:
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
    name, unit = own[0].plain_name, after_number(shown)
    stated = f"{figure(times * own[0].prior_value)} +- {figure(times * own[0].prior_sd, 2)}{unit}"
    return (
        f"{len(own)} runs were fitted far from what the study states: "
        f"{name} {low} to {high}{unit}, stated {stated}."
    )
