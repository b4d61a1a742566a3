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
    """What a law of a variable at an entry would explain.

    Attributes:
        variable: The variable in words.
        nats: Evidence over none.
        share: Share of the misfit of runs that were left out.
        wave_number: Of a law that repeats; 0: it does not.
        memory: Kind of the hidden state that the variable is; "": none.
        of: What drives the hidden state.
    """

    kind: str
    target: str
    variable: str
    nats: float
    share: float
    wave_number: float
    memory: str = ""
    of: str = ""


@dataclass(frozen=True)
class RunCurve:
    """The missing term over its variable, as one run tells it."""

    run: str
    u: tuple[float, ...]
    value: tuple[float, ...]


@dataclass(frozen=True)
class LawCurve:
    """The missing term over its variable, as the fitted runs tell it before it has a form.

    Attributes:
        law: Name of the law that it became; "": of none.
        u: Values of the variable.
        value, sd: The term there, with its standard deviation.
        runs: What each run alone says, where it went.
    """

    law: str
    u: tuple[float, ...]
    value: tuple[float, ...]
    sd: tuple[float, ...]
    unit: str = "-"
    runs: tuple[RunCurve, ...] = ()


@dataclass(frozen=True)
class DescribedLaw:
    """A law of the answer.

    Attributes:
        name: Name of the cause.
        entry: Kind and target of where it enters.
        variables: What it depends on.
        memory: Kind of its hidden state, or None.
        form: Kind of its formula.
        numbers: Size and further numbers.
        sentence: The law in words.
        looks_like: What it may be.
        status: How sure it is.
    """

    name: str
    entry: dict[str, str]
    variables: tuple[str, ...]
    memory: str | None
    form: str
    formula: str
    numbers: dict[str, Number]
    sentence: str
    looks_like: tuple[str, ...]
    status: str

    @property
    def place(self) -> tuple[str, str, tuple[str, ...]]:
        """Where it enters, and on what it depends."""
        return self.entry["kind"], self.entry["target"], self.variables


@dataclass(frozen=True)
class LawAnswer:
    """Laws of an answer, and the table that they were chosen from.

    Attributes:
        laws: Laws that the verdict holds.
        screen: Entries by variables, the best first.
        curves: Missing terms over their variables.
        num_tried: Laws without a form that were weighed.
    """

    laws: tuple[DescribedLaw, ...]
    screen: tuple[ScreenRow, ...]
    curves: tuple[LawCurve, ...] = ()
    num_tried: int = 0
