"""A machine and a law that is hidden in it: what they are, and how their motion is computed.

Nothing here knows the package that diagnoses: numpy, a Runge-Kutta method on a grid finer than
the samples, all runs side by side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: States, inputs, numbers, recorded columns and what pushes at each place (``push_PLACE``), now.
Now = dict[str, Any]
Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Sheet:
    """A number of the data sheet, in SI units."""

    value: float  # what the sheet says
    unit: str  # its unit
    percent: float = 0.0  # how well it is known; 0: exactly


@dataclass(frozen=True)
class Drive:
    """A command: its unit, where it swings around, and how far."""

    unit: str
    middle: float
    reach: float


@dataclass(frozen=True)
class Dial:
    """A channel of the recording."""

    formula: str  # of states and numbers, as the study says it
    unit: str  # of the file
    per_si: float  # what a reading in SI units is multiplied by for the file
    sd: float  # noise in SI units


@dataclass(frozen=True)
class Machine:
    """A machine as its owner describes it, with the same equations in numpy."""

    name: str  # of the machine
    states: Numbers  # names of the states, with their start values
    numbers: Mapping[str, Sheet]  # its data sheet
    drives: Mapping[str, Drive]  # commands by name
    dials: Mapping[str, Dial]  # channels by name
    rates: Callable[[Now], dict[str, Any]]  # what is now -> rates of the states
    shows: Callable[[Now], dict[str, Any]]  # what is now -> readings in SI units
    texts: Mapping[str, str]  # rates as formulas for the study; ``more``: further keys of its model
    # step_s, count: time between samples, and their number
    step_s: float
    count: int
    pace: float  # usual frequency of the commands [Hz]
    places: tuple[Mapping[str, str], ...] = ()  # where forces act, as the study says it
    more: Mapping[str, Any] = field(default_factory=dict)
    # low and high end of what the states do in the runs, for laws that act within
    extents: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def pushes(self) -> tuple[str, ...]:
        """Names under which a law pushes at the places."""
        return tuple(f"push_{place['name']}" for place in self.places)

    def reach(self, state: str) -> float:
        """How far a state goes from 0."""
        return max(abs(end) for end in self.extents[state])

    def within(self, state: str, share: float) -> float:
        """A value that far between the ends of a state."""
        low, high = self.extents[state]
        return low + share * (high - low)


@dataclass(frozen=True)
class Law:
    """A law that is hidden in a machine, its constants drawn.

    Attributes:
        entry: Where it enters: pairs of kind (force, rate, number, input, reading) and target, of
            which each says the same.
        variables: What it depends on; each list says the same.
        forms: Words for its form; each says the same.
        memory: Words for its hidden state; none without one.
        numbers: Size -> what can be held against intervals.
        typical, most: A usual size, and the greatest one that makes sense.
        acts: Changes what is now, before the machine's rates are computed.
        reads: Changes the readings.
        hidden: Start values of its own states.
        moves: What is now, and the machine's rates -> rates of its own states.
        columns: Recorded columns that it needs.
        alike: Causes of a library that say the same.
        bend: Size -> how far the form departs from a line within its range, as a share of what
            it does; a line says the same where so little cannot be seen.
    """

    entry: tuple[tuple[str, str], ...]
    variables: tuple[tuple[str, ...], ...]
    forms: tuple[str, ...]
    typical: float
    memory: tuple[str, ...] = ()
    numbers: Callable[[float], dict[str, float]] = lambda size: {}
    most: float = np.inf
    acts: Callable[[Now, float], None] = lambda now, size: None
    reads: Callable[[Now, dict[str, Any], float], None] = lambda now, shown, size: None
    hidden: Numbers = field(default_factory=dict)
    moves: Callable[[Now, dict[str, Any], float], dict[str, Any]] = lambda now, rates, size: {}
    columns: tuple[str, ...] = ()
    alike: tuple[str, ...] = ()
    bend: Callable[[float], float] = lambda size: np.inf


def driven_place(machine: Machine) -> tuple[str, tuple[tuple[str, str], ...]]:
    """Name of what pushes where the first command acts, and what no data tells from that.

    Args:
        machine: With a place; a force there, the velocity's rate and the command say the same.
    """
    place, drive = machine.places[0], next(iter(machine.drives))
    entry = (("force", place["name"]), ("rate", place["velocity"]), ("input", drive))
    return f"push_{place['name']}", entry


@dataclass(frozen=True)
class Courses:
    """What happens in all runs: commands held from sample to sample, columns straight between."""

    commands: Mapping[str, Array]  # (num_runs, num_samples) by name
    columns: Mapping[str, Array]  # the same for what was recorded besides


def with_extents(machine: Machine, numbers: Numbers, courses: Courses) -> Machine:
    """A machine that knows what its states do without a law: 2 to 98 % of all samples.

    Args:
        machine: Of the equations.
        numbers: Its numbers by name.
        courses: Of the runs.
    """
    shown = replace(
        machine,
        dials={name: Dial(name, "", 1.0, 1.0) for name in machine.states},
        shows=lambda now: {name: now[name] for name in machine.states},
    )
    seen = simulate(shown, numbers, courses, substeps=2)
    low, high = np.quantile(seen, (0.02, 0.98), axis=(1, 2))
    ends = zip(low.tolist(), high.tolist(), strict=True)
    return replace(machine, extents=dict(zip(machine.states, ends, strict=True)))


def simulate(
    machine: Machine,
    numbers: Mapping[str, Any],
    courses: Courses,
    law: Law | None = None,
    size: float = 0.0,
    substeps: int = 8,
) -> Array:
    """Readings without noise in SI units, (num_dials, num_runs, num_samples).

    Args:
        machine: Of the equations.
        numbers: Its numbers by name; an array holds one for each run.
        courses: Of the runs.
        law: What is hidden in it.
        size: Of the law.
        substeps: Steps of the method between two samples.
    """
    law = law if size else None
    hidden = law.hidden if law else {}
    num_runs, count = next(iter(courses.commands.values())).shape
    start = {**machine.states, **hidden}
    y = np.array([np.full(num_runs, float(s)) for s in start.values()])
    names = tuple(start)
    h = machine.step_s / substeps
    seen = np.empty((len(machine.dials), num_runs, count))

    def now_of(y: Array, k: int, share: float) -> Now:
        ahead = min(k + 1, count - 1)
        now: Now = dict(numbers)
        now.update(zip(names, y, strict=True))
        now.update((name, u[:, k]) for name, u in courses.commands.items())
        now.update(
            (name, (1.0 - share) * c[:, k] + share * c[:, ahead])
            for name, c in courses.columns.items()
        )
        now.update(dict.fromkeys(machine.pushes, 0.0))
        if law:
            law.acts(now, size)
        return now

    def slope(y: Array, k: int, share: float) -> Array:
        now = now_of(y, k, share)
        rates = machine.rates(now)
        if law:
            rates |= law.moves(now, rates, size)
        return np.array([rates[name] + np.zeros(num_runs) for name in names])

    for k in range(count):
        now = now_of(y, k, 0.0)
        shown = machine.shows(now)
        if law:
            law.reads(now, shown, size)
        seen[:, :, k] = [shown[name] for name in machine.dials]
        for j in range(substeps if k < count - 1 else 0):
            at, middle, end = (np.array([j, j + 0.5, j + 1]) / substeps).tolist()
            k1 = slope(y, k, at)
            k2 = slope(y + 0.5 * h * k1, k, middle)
            k3 = slope(y + 0.5 * h * k2, k, middle)
            y = y + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + slope(y + h * k3, k, end))
    if not np.all(np.isfinite(seen)):
        raise RuntimeError(f"{machine.name}: its motion with a law of size {size:g} is not finite")
    return seen
