"""What is put into words, and the small words of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.checks.noise import NoiseFloor
from diffsim.diagnose.judge.judge import Decision
from diffsim.diagnose.judge.records import (
    EFFECT,
    UNKNOWN,
    CauseRow,
    Interval,
)
from diffsim.identify.effect import is_of_run

MAX_SIZES = 3  # sizes of a cause in a sentence; the page lists all
_RELATIVE = ("-", "command", "channel")  # units that say nothing after a number


@dataclass(frozen=True, eq=False)
class Answer:
    """What is put into words.

    Attributes:
        verdict: Verdict of the report.
        decision: Decision of the evidence behind it.
        causes: All causes with their status.
        rivals: Names of the rival sets.
        gates: Checks.
        noise: Noise floor of the fitted runs.
        named: Effects that the verdict names.
        best_names: Effects of the best set.
        beside: Name of an unknown cause that leads beside the named set; empty if none.
        chosen_by: What chose between causes.
        strained: Parameters that the set takes further off their data sheets than even wrong ones
            lie while something unknown acts, in words, each with its distance [prior sd].
        left: What the set leaves, if that is much and an unknown cause explains it [noise sd].
    """

    verdict: str
    decision: Decision
    causes: tuple[CauseRow, ...]
    rivals: tuple[tuple[str, ...], ...]
    gates: tuple[GateResult, ...]
    noise: NoiseFloor
    named: tuple[str, ...] = ()
    best_names: tuple[str, ...] = ()
    beside: str = ""
    chosen_by: str = ""
    strained: Mapping[str, float] = field(default_factory=dict)
    left: float | None = None

    def told(self, *statuses: str, origin: str | None = None) -> list[CauseRow]:
        """Causes with a status, unknown ones left out."""
        return [
            row
            for row in self.causes
            if row.status in statuses
            and row.origin != UNKNOWN
            and (origin is None or row.origin == origin)
        ]


def effects_of(answer: Answer) -> list[CauseRow]:
    return [row for row in answer.causes if row.origin == EFFECT]


def plain_name(answer: Answer, name: str) -> str:
    return next((row.words for row in answer.causes if row.name == name), name)


def size_range(row: CauseRow, *, brief: bool = False) -> str:
    """Sizes of a cause with their 90 % intervals, or between which values many of them lie.

    Args:
        row: Cause with one size or more.
        brief: Say of two or more sizes, too, only between which values they lie.
    """
    row = row.as_read()
    if has_many_sizes(row) or (brief and len(row.size) > 1):
        return _spread(row)
    alone = len(row.size) == 1
    sizes = (f"{'' if alone else component_words(c) + ' '}{ends(s)}" for c, s in row.size.items())
    return f"{', '.join(sizes)}{after_number(row.unit)}"


def has_many_sizes(row: CauseRow) -> bool:
    """Whether its sizes are too many for a sentence."""
    return len(row.size) > (1 if all(map(is_of_run, row.size)) else MAX_SIZES)


def _spread(row: CauseRow) -> str:
    """Between which values the sizes lie; tables have each."""
    values = [size.value for size in row.size.values()]
    what = "runs" if all(map(is_of_run, row.size)) else "sizes"
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return f"{low} to {high}{after_number(row.unit)} in {len(values)} {what}"


def component_words(component: str) -> str:
    """A component of a size as it is read: "[propeller=10in]" is "propeller 10in"."""
    return component.strip("[]").replace("=", " ").replace("_", " ")


def after_number(unit: str) -> str:
    """A unit as it follows a number; nothing for one that is none."""
    return "" if unit in _RELATIVE else f" {unit}"


def ends(size: Interval) -> str:
    """Both ends with as many digits as tell them apart, two at least."""
    width = size.high - size.low
    for digits in range(2, 6):
        low, high = f"{size.low:.{digits}g}", f"{size.high:.{digits}g}"
        if low != high and abs(float(high) - float(low) - width) <= 0.25 * width:
            return f"{low} to {high}"
    return f"{size.value:.4g}"


def capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def opened(name: str) -> str:
    """The name of a parameter at the begin of a sentence; m and M are two parameters."""
    return name if len(name.partition(" ")[0]) <= 2 else capital(name)
