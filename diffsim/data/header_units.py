"""Units that the headers of files state, held against those of the study."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from diffsim.core.units import factor, to_si
from diffsim.data.names import COUNTER, unit_of_clock
from diffsim.data.study_check import Problem
from diffsim.data.study_file import read_whole
from diffsim.data.study_schema import ChannelEntry, CommandEntry, StudyFile
from diffsim.data.table_guess import column_of

#: What people write for a quantity that it is not the unit of: thrust stands weigh in g.
_LOOSE = {("g", "gf"), ("kg", "kgf"), ("counts", "-"), ("1/min", "rpm"), ("min^-1", "rpm")}
_FORCE = re.compile(r"thrust|force|kraft|schub|schubkraft|poussee", re.I)


def header_units(path: Path) -> Iterator[Problem]:
    """Columns that say one unit in brackets while the study says another.

    Args:
        path: ``study.yaml``, which was read before without a mistake.
    """
    stated = StudyFile.model_validate(read_whole(path))
    for clock in stated.time:
        if clock.column and clock.step is None:
            yield from _compare_units("time", clock.column, clock.unit)
            is_counter = COUNTER.match(column_of(clock.column).base) is not None
            if is_counter and "unit" not in clock.model_fields_set:
                said = f"column {clock.column} counts rows; give step, the seconds for each count"
                yield Problem("warning", "time", said)
    for what, entries in (("channel", stated.channels), ("command", stated.commands)):
        for entry in entries:
            if entry.unit is not None and _as_it_stands(entry):
                yield from _compare_units(
                    f"{what} {entry.name}", entry.column or entry.name, entry.unit
                )
            if entry.unit and to_si(entry.unit).unit == "kg" and _FORCE.search(entry.name):
                said = f"{entry.unit} is a mass; of a force write {entry.unit}f"
                yield Problem("warning", f"{what} {entry.name}", said)


def _as_it_stands(entry: ChannelEntry | CommandEntry) -> bool:
    return entry.formula is None and entry.scale == 1.0 and entry.offset == 0.0


def _compare_units(where: str, column: str, unit: str) -> Iterator[Problem]:
    header = column_of(column)
    said = header.unit or (unit_of_clock(column) if where == "time" else None)
    if said is None or "clock" in (said, unit) or (said, unit) in _LOOSE or _are_same(said, unit):
        return
    if not header.is_said and not _are_alike(said, unit):  # x_s may be the x of a slave
        return
    message = f"the header {column!r} says {said}, the study says unit: {unit}; which is right?"
    yield Problem("warning", where, message)


def _are_same(one: str, other: str) -> bool:
    if "-" in (one, other):
        return one == other
    try:
        shifted = to_si(one).offset - to_si(other).offset
        return abs(factor(one, other) - 1.0) < 1e-9 and shifted == 0.0
    except ValueError:  # units of different quantities
        return False


def _are_alike(one: str, other: str) -> bool:
    return to_si(one).unit == to_si(other).unit
