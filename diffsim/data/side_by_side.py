"""Runs that stand side by side in a table: a clock and readings of each, under labels.

Programs of teaching laboratories write them so: "Run 1: Time (s)", "Position (m) Run #2".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

_LABEL = r"(?:run|trial|test|data ?set|measurement|lauf|versuch|messung|essai) ?#? ?\d+|latest"
_BEFORE = re.compile(rf"(?P<label>{_LABEL}) ?[:,] ?(?P<name>.+)", re.IGNORECASE)
_CLOCK = re.compile(r"(time|t|zeit|temps|tiempo)( ?[(\[].*)?", re.IGNORECASE)
_AFTER = re.compile(rf"(?P<name>.+?)[ ,_]+(?P<label>{_LABEL})", re.IGNORECASE)


def runs_beside(header: Iterable[str]) -> Mapping[str, Mapping[str, str]]:
    """Columns of each run of a table that holds several side by side.

    Returns:
        By the run's label: the whole name of each column by the name without it; columns without a
        label are of all runs. Empty where there are fewer than two labels, or one has no clock of
        its own.
    """
    found: dict[str, dict[str, str]] = {}
    of_all: dict[str, str] = {}
    for name in header:
        matched = _BEFORE.fullmatch(name) or _AFTER.fullmatch(name)
        if matched:
            found.setdefault(matched["label"], {})[matched["name"]] = name
        elif name:
            of_all[name] = name
    have_clocks = (any(map(_CLOCK.fullmatch, columns)) for columns in found.values())
    if len(found) < 2 or not all(have_clocks):
        return {}
    return {label: {**of_all, **columns} for label, columns in found.items()}
