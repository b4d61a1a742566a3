"""The clock of tables, and the columns whose values divide a table into runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.units import to_si
from diffsim.data.names import CLOCK, COUNTER, PERIOD, RATE, TRIAL, may_be_time, unit_of_clock
from diffsim.data.stamps import filled
from diffsim.data.study_check import LATE
from diffsim.data.table import Table
from diffsim.data.table_guess import PLACE, TIME, Column

_FEWEST_ROWS = 5  # of a run, on average
_NUMBERED = 20  # rows from which on whole steps of one are no command
_T_OF = re.compile(r"[_ .]t$", re.I)
_MOST_EVEN = 0.9  # of the steps of a clock
_JUMP = 10.0  # times the usual step of a counter: another recording
_SINCE_1970 = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # counts in a second
_YEARS = (1e9, 4e9)  # s: 2001 to 2096
_LONGEST_STATED = 1.0  # s, likewise, of a step without a clock
_LONGEST = 100.0  # s between samples of a recording


def guess_clock(
    columns: Sequence[Column], tables: Sequence[Table], said: list[str]
) -> tuple[dict[str, Any], Column | None, list[str]]:
    """The clock: a column that is called so, the first one that only grows, or a counter.

    Args:
        tables: Files of the folder, read as tables.
        said: Sentences on what was guessed; more are added.

    Returns:
        Keys of ``time``, the column, and what the user must say.
    """
    stated = _stated_step(columns, tables[0])
    columns = [c for c in columns if c.name and (stated is None or c is not stated[0])]
    named = [c for c in columns if TIME.match(c.base) and may_be_time(c)]
    for column in (*named, *(c for c in columns if c not in named)):
        if not tables[0].is_number[column.name]:
            if column in named or _tells_time(column, tables[0]):
                said.append(f"clock: column {column.name}, as times of day or dates")
                return {"column": column.name, "unit": "clock"}, column, []
        elif column in named or (_is_clock_by_unit(column) and _grows(column, tables)):
            return _numeric_time(column, tables, said)
    for column in columns:
        is_number = tables[0].is_number[column.name] and not COUNTER.match(column.base)
        if column.unit is None and is_number and _numbers_rows(column, tables):
            continue  # whole steps of one count frames: no unit follows from these
        # a speed that a bench sweeps only grows, too
        if is_number and may_be_time(column) and _is_even(column, tables[0]):
            said.append(f"clock: column {column.name}, the first that only grows")
            return _numeric_time(column, tables, said)
    for column in columns:
        is_named = is_counter(column, tables[0], np.arange(len(tables[0])))
        if (is_named and _counts(column, tables)) or _numbers_rows(column, tables):
            what, between = f"column {column.name} counts", f"for each count of {column.name}"
            time, todo = _step_of_rows(what, between, stated, said)
            return {"column": column.name, **time}, column, todo
    time, todo = _step_of_rows("no column looks like one", "between two rows", stated, said)
    return time, None, todo


def _stated_step(columns: Sequence[Column], table: Table) -> tuple[Column, float] | None:
    """The column that states how far rows are apart, a rate or a step that stays, and how far [s];
    None: none does."""
    for column in columns:
        is_rate = bool(RATE.search(column.name) or RATE.search(column.base))
        if not is_rate and not (PERIOD.search(column.name) or PERIOD.search(column.base)):
            continue
        if not table.is_number[column.name]:
            continue
        values = table.numbers(column.name)
        unit = to_si(column.unit or ("Hz" if is_rate else "s"))
        if (values == values[0]).all() and values[0] > 0.0 and unit.unit in ("s", "1/s", "Hz"):
            size = unit.factor * float(values[0])
            step = size if unit.unit == "s" else 1.0 / size
            if step < _LONGEST_STATED:  # the throttle of an airplane is called dt, too
                return column, step
    return None


def _step_of_rows(
    what: str, between: str, stated: tuple[Column, float] | None, said: list[str]
) -> tuple[dict[str, float], list[str]]:
    """The step of a clock that is none, and what the user must say."""
    if stated is not None:
        column, step = stated
        said.append(f"clock: {what}; rows are {step:.6g} s apart by {column.name}")
        return {"step": float(f"{step:.12g}")}, []
    said.append(f"clock: {what}; rows are 0.01 s apart until you say otherwise")
    return {"step": 0.01}, [f"time.step: seconds {between}"]


def seconds_of(table: Table, time: Mapping[str, Any]) -> Array:
    """Clock of a table [s] by keys of ``time``."""
    unit = time.get("unit", "s")
    factor = None if unit == "clock" else to_si(unit).factor
    return table.seconds(time.get("column"), factor, time.get("step"))


def is_late(table: Table, time: Mapping[str, Any]) -> bool:
    """Whether a clock counts from long ago, as seconds since 1970 do."""
    if "step" in time or time["unit"] == "clock":
        return False
    return bool(seconds_of(table, time)[0] > LATE)


def is_counter(column: Column, table: Table, rows: IntArray) -> bool:
    """Whether a column is called a counter, and counts."""
    if not COUNTER.match(column.base) or not table.is_number[column.name]:
        return False
    step = np.diff(table.numbers(column.name)[rows])
    return bool(len(step)) and bool((step == np.round(step)).all())


def guess_split(
    columns: Sequence[Column], tables: Sequence[Table], clock: Column | None, said: list[str]
) -> tuple[Column, ...]:
    """Columns whose values are runs: they change where the clock starts again, or name trials."""
    table = tables[0]
    if clock is not None and table.is_number[clock.name]:
        now = table.numbers(clock.name)
        step = np.diff(now[: filled(now)])
        is_jump = step < 0.0
        if COUNTER.match(clock.base):
            is_jump |= step > _JUMP * np.median(step)
        back = np.flatnonzero(is_jump)
        return _split_at(back, columns, table, clock, said) if len(back) else ()
    if clock is not None or len(tables) > 1:
        return ()
    found = [c for c in columns if c.name and _names_trials(c, table)]
    if found:
        names = " and ".join(c.name for c in found)
        said.append(f"runs: {names} stay the same for many rows: one run for each value")
    return tuple(found)


def _tells_time(column: Column, table: Table) -> bool:
    """Whether a column of text holds times of day or dates that move on."""
    try:
        seconds = table.seconds(column.name, None, None)
    except ValueError:
        return False
    return len(seconds) > 1 and bool(seconds[-1] > seconds[0])


def _numeric_time(
    column: Column, tables: Sequence[Table], said: list[str]
) -> tuple[dict[str, Any], Column, list[str]]:
    now = tables[0].numbers(column.name)
    now = now[np.isfinite(now)]
    step = float(np.median(np.abs(np.diff(now)))) if len(now) > 1 else 0.0
    unit, todo, how = column.unit, [], ""
    if unit is None:
        # "elapsed s": of a clock its last word may be a unit, which elsewhere is a letter
        unit = unit_of_clock(column.base) or unit_of_clock(column.name.rpartition(" ")[2])
    if unit is None or (unit != "-" and to_si(unit).unit != "s") or unit == "-":
        if (since := _unit_since_1970(now, step)) is not None:
            unit, how = since, " since 1970 by its values"
        else:
            unit = unit_by_step(step)
            last = float(now[-1] - now[0]) if len(now) else 0.0
            todo = [
                f"time.unit: column {column.name} states none; {unit} is a guess by its steps: "
                f"{tables[0].path.name} would take {last * to_si(unit).factor:.3g} s"
            ]
    said.append(f"clock: column {column.name} in {unit}{how}, steps of {step:.4g} {unit}")
    return {"column": column.name, "unit": unit}, column, todo


def unit_by_step(step: float) -> str:
    """Unit of a clock that states none, by its usual step: recordings step by 0.1 ms to some
    seconds, and nobody counts seconds in thousands."""
    return "s" if step < 0.5 else "ms" if step < 500.0 else "us"


def _unit_since_1970(now: Array, step: float) -> str | None:
    """Unit in which readings are dates of our time; None: they are none."""
    first = now[0] if len(now) else 0.0
    for unit, size in _SINCE_1970.items():
        if _YEARS[0] <= first / size < _YEARS[1] and step / size < _LONGEST:
            return unit
    return None


def _is_clock_by_unit(column: Column) -> bool:
    """Whether a column is called by a unit of time, as uptime or millis is, or states one in any
    language: ts_us, "tempo (s)"."""
    by_name = bool(unit_of_clock(column.base) or CLOCK.search(column.base))
    return by_name or (column.unit not in (None, "-") and to_si(column.unit).unit == "s")


def _grows(column: Column, tables: Sequence[Table]) -> bool:
    """Whether a clock goes on; some of its stamps may be equal."""
    step = np.diff(tables[0].numbers(column.name))
    enough = max(min(_FEWEST_ROWS, len(step)), 0.1 * len(step))
    return bool((step >= 0.0).all() and (step > 0.0).sum() >= enough)


def _is_even(column: Column, table: Table) -> bool:
    """Whether a column goes on by the same from row to row; but for a few rows where it has no
    name, and where it is called plate_t, of which some stamps may be equal, too."""
    step, is_t = np.diff(table.numbers(column.name)), bool(_T_OF.search(column.name))
    step = step[step != 0.0] if is_t else step
    if not len(step) or not (step > 0.0).all():
        return False
    usual = float(np.median(step))
    is_loose = is_t or column.name == PLACE.format(1)
    off = np.abs(step - usual) if is_loose else np.array([np.ptp(step)])
    return bool(np.mean(off < 0.5 * usual) > _MOST_EVEN)


def _counts(column: Column, tables: Sequence[Table]) -> bool:
    """Whether a counter goes up from row to row, but for the starts of other recordings."""
    step = np.diff(tables[0].numbers(column.name))
    return bool(np.mean(step > 0.0) > 1.0 - 1.0 / _FEWEST_ROWS)


def _numbers_rows(column: Column, tables: Sequence[Table]) -> bool:
    """Whether a column of any name goes up by one from row to row, as frames do, in all files."""
    if not all(t.is_number[column.name] for t in tables):
        return False
    steps = [np.diff(t.numbers(column.name)) for t in tables]
    on = [s == 1.0 for s in steps if len(s) >= _NUMBERED]
    return len(on) == len(tables) and bool(np.mean(np.concatenate(on)) > 0.9)


def _split_at(
    back: IntArray, columns: Sequence[Column], table: Table, clock: Column, said: list[str]
) -> tuple[Column, ...]:
    for column in columns:
        if not column.name or column is clock:
            continue
        cells = table.values(column.name)
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
    if num_stretches == 1 or _FEWEST_ROWS * num_stretches > len(cells) or "" in cells:
        return False
    return not table.is_number[column.name] or bool(TRIAL.match(column.base))
