"""Laws that nobody listed: where one may enter, on what it may depend, and how it is written.

An entry is a place of the model where a term may be added, a variable what the term may depend on.
A law is a term of one variable at one entry. Systems that can be extended by laws offer a
``setup.LawPort``; the diagnosis asks it for entries and variables and knows nothing of the system.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy import sparse

from diffsim.core.arrays import Array
from diffsim.data.study import Study

Where = Literal["force", "rate", "number", "value", "input", "reading"]
Memory = Literal["", "heat", "slip", "oscillator", "relaxation", "work"]
VALUE = "u"  # what the variable is called in the formula of a term
SIZE = "size"
LAWS = "laws"  # place of found laws in a study's frame
#: shares of the longest run that memories are tried to last
LASTING = (0.03, 0.1, 0.3, 1.0)
FEWEST_PERIODS = 2.0  # over a range or a run: fewer are no repetition, but a trend
FEWEST_VALUES = 4  # of what is constant over a run, for a law over it


@dataclass(frozen=True)
class Entry:
    """A place of the model where a term may be added.

    Attributes:
        kind: "force" at a place, "rate" of a state, "number" (the term is added to its factor 1),
            "value" of a number that may be zero, "input" or "reading".
        target: Name of the place, state, number, input or channel.
        unit: Unit of the term.
        scale: Usual magnitude there [unit]: a term of a tenth of it would be no surprise.
        channel: Index of the channel, of a reading.
        per: Formula of what the term is divided by; None: nothing.
        parts: Alike entries at all of which one law acts; (): it is one entry.
    """

    kind: Where
    target: str
    unit: str
    scale: float
    channel: int = -1
    per: str | None = None
    parts: tuple[Entry, ...] = ()

    @property
    def words(self) -> str:
        """The entry as a reader sees it, such as "force at shaft"."""
        if self.kind == "force":
            return f"force at {self.target}"
        if self.kind in ("number", "value"):
            return self.target
        return f"{self.kind} of {self.target}"


@dataclass(frozen=True)
class HiddenState:
    """A state that a variable needs beside those of the model.

    Attributes:
        rate: Formula of its rate.
        start: Formula of its start value.
    """

    rate: str
    start: str = "0"


@dataclass(frozen=True)
class Variable:
    """What a law may depend on.

    Attributes:
        name: Name in words, such as "angle" or "heat of current^2".
        formula: Formula in the names of the model, of recorded columns and hidden states.
        columns: Recorded columns that the formula needs.
        states: Hidden states that it needs, by name.
        memory: Kind of the hidden state; "": none.
        of: What drives the hidden state.
        numbers: Numbers of the hidden states, tried values by name; fitted later.
        is_turn: Whether laws that repeat are tried: states, readings and time, not what is hidden.
        at: Words of the entries at which a law of it may enter; (): all.
        times: What all of a law of it is multiplied by; None: nothing.
        parts: At alike entries, what stands for it at each; (): the same everywhere.
    """

    name: str
    formula: str
    unit: str = "-"
    columns: tuple[str, ...] = ()
    states: Mapping[str, HiddenState] = field(default_factory=dict)
    memory: Memory = ""
    of: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    number_units: Mapping[str, str] = field(default_factory=dict)
    is_turn: bool = False
    at: tuple[str, ...] = ()
    times: Variable | None = None
    parts: tuple[Variable, ...] = ()

    def at_parts(self, entry: Entry) -> tuple[tuple[Entry, Variable], ...]:
        """Where a law of it enters, and what it depends on there."""
        where = entry.parts or (entry,)
        return tuple(zip(where, self.parts or (self,) * len(where), strict=True))

    def may_be_at(self, entry: Entry) -> bool:
        """Whether a law of it may enter somewhere; at several places at once if it is plain."""
        return entry.words in self.at or not (self.at or (entry.parts and self.memory))

    @property
    def own_name(self) -> str:
        """The name without what a law of it is multiplied by."""
        return self.name if self.times is None else self.name.removesuffix(_times(self.times))

    def with_factor(self, other: Variable) -> Variable:
        """The same of laws that are multiplied by another variable, such as wind by an angle."""
        columns = tuple(dict.fromkeys((*self.columns, *other.columns)))
        name = self.name + _times(other)
        return replace(self, name=name, columns=columns, is_turn=False, times=other)


def _times(other: Variable) -> str:
    return f" times {other.name}"


@dataclass(frozen=True, eq=False)
class Gains:
    """What a unit at an entry does in a run, at its samples, where the simulation is."""

    rates: Array  # to each rate that has a course (``LawPort.drives``), (num_samples, num_courses)
    readings: Array  # to each channel at once, (num_samples, num_channels)
    # what the model's own start states leave of changes of all readings, sample by sample,
    # (num_samples * num_channels, ...); None: all of it
    left: Callable[[sparse.csr_array], sparse.csr_array] | None = None


@dataclass(frozen=True)
class Shape:
    """A number of a law beside its size.

    Attributes:
        value: Most probable value before it is fitted in the simulator.
        sd: Its standard deviation.
        unit: Unit.
        lower, upper: Bounds.
    """

    value: float
    sd: float
    unit: str = "-"
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True)
class Law:
    """A term of one variable at one entry.

    Attributes:
        name: Plain name, such as "law_1".
        entry: Where it is added.
        variable: On what it depends.
        form: Kind of the formula: "line", "periodic", "power", ...
        term: Formula of ``u`` (the variable), ``size`` and the shapes.
        typical: Size that would be no surprise.
        unit: Unit of the size.
        shapes: Numbers of the formula and of hidden states beside the size.
        price: Nats that the choice among all that was tried costs.
        signed: Whether the size may be negative.
        sign: Of the size, as it was found.
    """

    name: str
    entry: Entry
    variable: Variable
    form: str
    term: str
    typical: float
    unit: str
    shapes: Mapping[str, Shape] = field(default_factory=dict)
    price: float = 0.0
    signed: bool = True
    sign: float = 1.0


def put_variable(term: str, variable: Variable) -> str:
    """The formula of a term with that of its variable put in, and what it is multiplied by."""
    text = re.sub(rf"\b{VALUE}\b", lambda _: f"({variable.formula})", term)
    return text if variable.times is None else f"({text})*({variable.times.formula})"


def numbers_of(shape: Shape) -> dict[str, float | str]:
    """A number of a law as a cause of a user states it."""
    stated = {"value": shape.value, "sd": shape.sd, "lower": shape.lower, "upper": shape.upper}
    return {k: v for k, v in stated.items() if math.isfinite(v)} | {"unit": shape.unit}


def reading_entries(study: Study) -> tuple[Entry, ...]:
    """The readings of a study as entries of laws."""
    out = []
    for k, channel in enumerate(study.channels):
        column = [run.measured[:, k] for run in study.fit_runs]
        usual = float(np.nanstd(np.concatenate(column))) or 1.0
        out.append(Entry("reading", channel.name, channel.unit, usual, k))
    return tuple(out)
