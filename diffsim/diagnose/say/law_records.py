"""Laws of an answer, as a report holds them."""

from __future__ import annotations

from dataclasses import dataclass

DESCRIBED = "described"  # verdict of an answer that holds a law


@dataclass(frozen=True)
class Number:
    """A number of a law with its 90 % interval."""

    value: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class ScreenRow:
    """What a law of a variable at an entry would explain."""

    kind: str
    target: str
    variable: str  # the variable in words
    nats: float  # evidence over none
    share: float  # share of the misfit of runs that were left out
    wave_number: float  # of a law that repeats; 0: it does not
    memory: str = ""  # kind of the hidden state that the variable is; "": none
    of: str = ""  # what drives the hidden state


@dataclass(frozen=True)
class RunCurve:
    """The missing term over its variable, as one run tells it."""

    run: str
    u: tuple[float, ...]
    value: tuple[float, ...]


@dataclass(frozen=True)
class LawCurve:
    """The missing term over its variable, as the fitted runs tell it before it has a form."""

    law: str  # name of the law that it became; "": of none
    u: tuple[float, ...]  # values of the variable
    # value, sd: the term there, with its standard deviation
    value: tuple[float, ...]
    sd: tuple[float, ...]
    unit: str = "-"
    runs: tuple[RunCurve, ...] = ()  # what each run alone says, where it went


@dataclass(frozen=True)
class DescribedLaw:
    """A law of the answer."""

    name: str  # name of the cause
    entry: dict[str, str]  # kind and target of where it enters
    variables: tuple[str, ...]  # what it depends on
    memory: str | None  # kind of its hidden state, or None
    form: str  # kind of its formula
    formula: str
    numbers: dict[str, Number]  # size and further numbers
    sentence: str  # the law in words
    looks_like: tuple[str, ...]  # what it may be
    status: str  # how sure it is

    @property
    def place(self) -> tuple[str, str, tuple[str, ...]]:
        """Where it enters, and on what it depends."""
        return self.entry["kind"], self.entry["target"], self.variables


@dataclass(frozen=True)
class LawAnswer:
    """Laws of an answer, and the table that they were chosen from."""

    laws: tuple[DescribedLaw, ...]  # laws that the verdict holds
    screen: tuple[ScreenRow, ...]  # entries by variables, the best first
    curves: tuple[LawCurve, ...] = ()  # missing terms over their variables
    num_tried: int = 0  # laws without a form that were weighed
