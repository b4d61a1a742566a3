"""What is fitted to a run whatever it is used for: values that are its own ("offset@run")."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from scipy import optimize

from diffsim.core.arrays import Array
from diffsim.core.figures import figure
from diffsim.core.units import after_number, small_scale
from diffsim.data.study import Run
from diffsim.diagnose.search.search import FAR_OFF
from diffsim.identify import Problem
from diffsim.identify.effect import PRIOR_WIDTH
from diffsim.identify.effort import FIT_RTOL

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
) -> Array:
    """Coordinates with the values of one run ("offset@run") fitted to it, all others as given.

    Args:
        problem: Model and noise, with this run only.
        x: Standardized coordinates, (n,); the run's own are fitted from the middle of their prior.
        slopes: Whitened slopes of the run's rows, (num_valid, n); None: simulated at every step.
        unmet: Parameters that no fitted run has, as of ``own_names``.
    """
    names = set(own_names(problem.names, run, unmet))
    own = [i for i, n in enumerate(problem.names) if n in names]
    if not own:
        return x
    # what is stated per run acts almost linearly: slopes of the fit serve for all steps; a size is
    # no straight function of its coordinate
    is_straight = not names & set(unmet) and max(own) < problem.num_base
    held = -slopes[:, own] if slopes is not None and is_straight else None

    def full(part: Array) -> Array:
        """All coordinates, (n,)."""
        point = x.copy()
        point[own] = part
        return point

    def columns(part: Array) -> Array:
        """Slopes of the residual and of the prior below, (num_valid + num_own, num_own)."""
        at = -problem.linearize(full(part), only=own)[1] if held is None else held
        return np.vstack([at, np.eye(len(own))])

    low, high = (bound[own] for bound in problem.bounds)
    is_bounded = np.isfinite(low).any() or np.isfinite(high).any()
    found = optimize.least_squares(
        lambda part: np.concatenate([problem.residual(full(part)), part]),
        np.clip(np.zeros(len(own)), low, high),
        jac=columns,
        bounds=(low, high),
        method="dogbox" if is_bounded else "trf",
        ftol=FIT_RTOL,
        # slopes that are a little wrong end in ever shorter steps, none of which gains anything
        xtol=1e-8 if held is None else 1e-3,
    )
    return full(np.asarray(found.x))


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
    name, unit = own[0].plain_name, after_number(shown)
    stated = f"{figure(times * own[0].prior_value)} +- {figure(times * own[0].prior_sd, 2)}{unit}"
    return (
        f"{len(own)} runs were fitted far from what the study states: "
        f"{name} {low} to {high}{unit}, stated {stated}."
    )
