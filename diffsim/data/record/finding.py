"""What a rule of the record sees, and what a rule is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from diffsim.core.checked import checked
from diffsim.data.record.signals import Record

MOST_SHOWN = 3  # rows that a sentence names


@checked(kinds_only=True)
@dataclass(frozen=True)
class Finding:
    """One fault of a record.

    Attributes:
        where: "run a", "channel angle", "command goal".
        says: What is wrong, with rows and values.
        remedy: What mends it, as keys of study.yaml.
        stops: Whether no physics may be asked before it is mended.
        rule: Name of the rule that saw it.
    """

    where: str
    says: str
    remedy: str
    stops: bool
    rule: str = ""

    def __str__(self) -> str:
        return f"{self.says}: {self.remedy}" if self.remedy else self.says


@checked(kinds_only=True)
@dataclass(frozen=True)
class RecordRule:
    """One way in which a record can be wrong.

    Attributes:
        name: Short name.
        sees: What it looks for, in words.
        keys: Keys of study.yaml that mend it.
        find: All places of a record.
    """

    name: str
    sees: str
    keys: str
    find: Callable[[Record], Iterator[Finding]]


def rows_shown(times: list[float]) -> str:
    """The first of some times, such as "at 0.2, 0.5, 0.9 s and 4 more"."""
    more = f" and {len(times) - MOST_SHOWN} more" if len(times) > MOST_SHOWN else ""
    return f"at {', '.join(f'{t:.6g}' for t in times[:MOST_SHOWN])} s{more}"
