"""Runs that stand side by side in a table: a clock and readings of each, under labels.

Programs of teaching laboratories write them so: "Run 1: Time (s)", "Position (m) Run #2".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

_LABEL = r"(?:run|trial|test|data ?set|measurement|lauf|versuch|messung|essai) ?#? ?\d+|latest"
_BEFORE = re.compile(rf"({_LABEL}) ?[:,] ?(?P<name>.+)", re.IGNORECASE)
_CLOCK = re.compile(r"(time|t|zeit|temps|tiempo)( ?[(\[].*)?", re.IGNORECASE)
_AFTER = re.compile(rf"(?P<name>.+?)[ ,_]+({_LABEL})", re.IGNORECASE)


def runs_beside(header: Iterable[str]) -> Mapping[str, Mapping[str, str]]:
    """Columns of each run of a table that holds several side by side.

    Args:
        header: Names of the columns.

    Returns:
        By the run's label: the whole name of each column by the name without it. Empty where there
        are fewer than two labels, or one has no clock of its own.
    """
    found: dict[str, dict[str, str]] = {}
    for name in header:
        for pattern in (_BEFORE, _AFTER):
            if matched := pattern.fullmatch(name):
                label = next(group for group in matched.groups() if group != matched["name"])
                found.setdefault(label, {})[matched["name"]] = name
                break
    have_clocks = (any(map(_CLOCK.fullmatch, columns)) for columns in found.values())
    return found if len(found) > 1 and all(have_clocks) else {}
