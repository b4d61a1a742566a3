"""The clock of an unknown folder, and the columns whose values divide a file into runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.units import to_si
from diffsim.data.study_check import LATE
from diffsim.data.table import Table
from diffsim.data.table_guess import Column, TableLayout

TIME = re.compile(
    r"^(t|time|timestamp|stamp|zeit|zeitstempel|temps|tiempo|seconds|elapsed|clock)(_|$)", re.I
)
#: What people call a clock by its unit alone.
_UNITS = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden"), "s"),
    **dict.fromkeys(("ms", "millis", "msec", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "micros", "usec", "microseconds"), "us"),
    **dict.fromkeys(("min", "mins", "minute", "minutes", "minuten"), "min"),
    **dict.fromkeys(("h", "hr", "hrs", "hour", "hours", "stunden"), "h"),
}
COUNTER = re.compile(r"^(frame|sample|index|idx|i|n|row|count|counter|seq|nr|no)$", re.I)
_TRIAL = re.compile(
    r"^(run|trial|test|sweep|pass|series|cycle|rep|repeat|repetition|experiment|exp|throw|toss|"
    r"shot|episode|lauf|versuch|messung)(_?(no|nr|id|number|index|\d))?$",
    re.I,
)
_LEAST_ROWS = 5  # of a run, on average
_NUMBERED = 20  # rows from which on whole steps of one are no command
_JUMP = 10.0  # times the usual step of a counter: another recording


def guess_clock(
    layout: TableLayout, tables: Sequence[Table], said: list[str]
) -> tuple[dict[str, Any], Column | None, list[str]]:
    """The clock: a column that is called so, the first one that only grows, or a counter.

    Args:
        layout: Columns of the files.
        tables: Files of the folder, read as tables.
        said: Sentences on what was guessed; more are added.

    Returns:
        Keys of ``time``, the column, and what the user must say.
    """
    named = [c for c in layout.columns if TIME.match(c.base) and may_be_time(c)]
    for column in (*named, *(c for c in layout.columns if c.name and c not in named)):
        if not tables[0].is_number[column.name]:
            if column in named or _tells_time(column, tables[0]):
                said.append(f"clock: column {column.name}, as times of day or dates")
                return {"column": column.name, "unit": "clock"}, column, []
        elif column in named or (unit_of_clock(column.base) and _grows(column, tables)):
            return _numeric_time(column, tables, said)
    for column in layout.columns:
        if column.name and tables[0].is_number[column.name] and not COUNTER.match(column.base):
            step = np.diff(tables[0].numbers(column.name))
            if len(step) and (step > 0.0).all() and np.ptp(step) < 0.5 * np.median(step):
                said.append(f"clock: column {column.name}, the first that only grows")
                return _numeric_time(column, tables, said)
    for column in layout.columns:
        is_named = is_counter(column, tables[0], np.arange(len(tables[0])))
        if (is_named and _counts(column, tables)) or _numbers_rows(column, tables):
            said.append(f"clock: column {column.name} counts, by 0.01 s until you say otherwise")
            todo = [f"time.step: seconds for each count of {column.name}"]
            return {"column": column.name, "step": 0.01}, column, todo
    said.append("clock: no column looks like one; rows are 0.01 s apart until you say otherwise")
    return {"step": 0.01}, None, ["time.step: seconds between two rows"]


def may_be_time(column: Column) -> bool:
    """Whether the unit of a column is one of time, or is not stated: T_wall [degC] is no clock."""
    return column.unit in (None, "-") or to_si(column.unit).unit == "s"


def _tells_time(column: Column, table: Table) -> bool:
    """Whether a column of text holds times of day or dates that move on."""
    try:
        seconds = table.seconds(column.name, None, None)
    except ValueError:
        return False
    return len(seconds) > 1 and bool(seconds[-1] > seconds[0])


def unit_of_clock(header: str) -> str | None:
    """Unit of a clock whose header is its unit, such as ``min``; None: it says none."""
    return _UNITS.get(header.strip().lower())


def is_late(time: dict[str, Any], clock: Column | None, tables: Sequence[Table]) -> bool:
    """Whether a clock of seconds since 1970, or the like, is to start at 0 in every run."""
    if clock is None or "unit" not in time or time["unit"] == "clock":
        return False
    return bool(tables[0].numbers(clock.name)[0] * to_si(time["unit"]).factor > LATE)


def is_counter(column: Column, table: Table, rows: NDArray[np.int64]) -> bool:
    """Whether a column is called a counter, and counts."""
    if not COUNTER.match(column.base) or not table.is_number[column.name]:
        return False
    step = np.diff(table.numbers(column.name)[rows])
    return bool(len(step)) and bool((step == np.round(step)).all())


def guess_split(
    layout: TableLayout, tables: Sequence[Table], clock: Column | None, said: list[str]
) -> tuple[Column, ...]:
    """Columns whose values are runs: they change where the clock starts again, or name trials."""
    table = tables[0]
    if clock is not None and table.is_number[clock.name]:
        step = np.diff(table.numbers(clock.name))
        is_jump = step <= 0.0
        if COUNTER.match(clock.base):
            is_jump |= step > _JUMP * np.median(step)
        back = np.flatnonzero(is_jump)
        return _split_at(back, layout, table, clock, said) if len(back) else ()
    if clock is not None or len(tables) > 1:
        return ()
    found = [c for c in layout.columns if c.name and _names_trials(c, table)]
    if found:
        names = " and ".join(c.name for c in found)
        said.append(f"runs: {names} stay the same for many rows: one run for each value")
    return tuple(found)


def _numeric_time(
    column: Column, tables: Sequence[Table], said: list[str]
) -> tuple[dict[str, Any], Column, list[str]]:
    step = float(np.nanmedian(np.abs(np.diff(tables[0].numbers(column.name)))))
    unit, todo = column.unit, []
    if unit is None:
        unit = unit_of_clock(column.base)
    if unit is None or (unit != "-" and to_si(unit).unit != "s") or unit == "-":
        # recordings step by 0.1 ms to some seconds, and nobody counts seconds in thousands
        unit = "s" if step < 0.5 else "ms" if step < 500.0 else "us"
        todo = [f"time.unit: column {column.name} states none; {unit} is a guess by its steps"]
    said.append(f"clock: column {column.name} in {unit}, steps of {step:.4g} {unit}")
    return {"column": column.name, "unit": unit}, column, todo


def _grows(column: Column, tables: Sequence[Table]) -> bool:
    return bool((np.diff(tables[0].numbers(column.name)) > 0.0).all())


def _counts(column: Column, tables: Sequence[Table]) -> bool:
    """Whether a counter goes up from row to row, but for the starts of other recordings."""
    step = np.diff(tables[0].numbers(column.name))
    return bool(np.mean(step > 0.0) > 1.0 - 1.0 / _LEAST_ROWS)


def _numbers_rows(column: Column, tables: Sequence[Table]) -> bool:
    """Whether a column of any name goes up by one from row to row, as frames do, in all files."""
    if not column.name or not all(t.is_number[column.name] for t in tables):
        return False
    steps = [np.diff(t.numbers(column.name)) for t in tables]
    on = [s == 1.0 for s in steps if len(s) >= _NUMBERED]
    return len(on) == len(tables) and bool(np.mean(np.concatenate(on)) > 0.9)


def _split_at(
    back: NDArray[np.int64], layout: TableLayout, table: Table, clock: Column, said: list[str]
) -> tuple[Column, ...]:
    for column in layout.columns:
        if not column.name or column is clock:
            continue
        cells = np.array(table.texts(column.name))
        changes = np.flatnonzero(cells[1:] != cells[:-1])
        if set(back) <= set(changes) and len(changes) <= 2 * len(back) + 2 < len(cells):
            said.append(f"runs: the clock starts again where {column.name} changes: one run each")
            return (column,)
    said.append(
        f"the clock of {table.path.name} goes back or jumps {len(back)} times, but no column "
        "changes there"
    )
    return ()


def _names_trials(column: Column, table: Table) -> bool:
    """A label, or a number that is called a trial, that stays for many rows."""
    cells = np.array(table.texts(column.name))
    num_stretches = 1 + int((cells[1:] != cells[:-1]).sum())
    if num_stretches == 1 or _LEAST_ROWS * num_stretches > len(cells) or "" in cells:
        return False
    return not table.is_number[column.name] or bool(_TRIAL.match(column.base))
