"""Files of several instruments that recorded the same runs: told by what their names share."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.units import to_si
from diffsim.data.clock_guess import guess_clock
from diffsim.data.steps import rest_and_jump
from diffsim.data.table import Table
from diffsim.data.table_guess import Column, TableLayout

_LAST = re.compile(r"(?P<rest>.+)[_\-. ](?P<tag>[^_\-. ]+)")
_FIRST = re.compile(r"(?P<tag>[^_\-. ]+)[_\-. ](?P<rest>.+)")
_MEETS = 0.5  # of the shorter record: clocks of one run overlap by more


def paired(first: Sequence[str], second: Sequence[str]) -> dict[str, tuple[int, int]] | None:
    """Files of two kinds that share their names but for a word: run1_mocap and run1_imu.

    Args:
        first: Stems of the files of one kind.
        second: Stems of those of another kind.

    Returns:
        Index in both by what they share, in the order of ``first``; None where one of the first
        has no partner.
    """
    for tag, rests in _find_tags(first):
        for other, others in _find_tags(second):
            if tag != other and set(rests) <= set(others):
                return {rest: (at, others[rest]) for rest, at in rests.items()}
    return None


def _find_tags(stems: Sequence[str]) -> Iterator[tuple[str, Mapping[str, int]]]:
    """A word that all stems end or begin with, or none, and what is left of them."""
    for pattern in (_LAST, _FIRST):
        found = [pattern.fullmatch(stem) for stem in stems]
        tags = {m["tag"] for m in found if m is not None}
        # a number counts runs, a word tells instruments apart
        if None not in found and len(tags) == 1 and not (tag := tags.pop()).isdigit():
            yield tag, {m["rest"]: i for i, m in enumerate(found) if m is not None}
    yield "", {stem: i for i, stem in enumerate(stems)}


def clocks_of(
    layouts: Sequence[TableLayout], tables: Sequence[Sequence[Table]]
) -> list[dict[str, Any]] | None:
    """Keys of ``time`` for each kind of file, where one study can state them all.

    Args:
        layouts: Columns of each kind.
        tables: Files of each kind, run by run.

    Returns:
        None where a kind has no clock, where a study would take another kind's, or where the
        clocks of the first run do not meet.
    """
    stated: list[dict[str, Any]] = []
    for layout, own in zip(layouts, tables, strict=True):
        time, _, _ = guess_clock(layout, own, [])
        names = {c.name for c in layout.columns}
        taken = next((t for t in stated if t["column"] in names), time)
        if "unit" not in time or taken != time:
            return None
        stated.append(time)
    clocks = [_seconds(own[0], time) for own, time in zip(tables, stated, strict=True)]
    shared = min(c[-1] for c in clocks) - max(c[0] for c in clocks)
    return stated if shared > _MEETS * min(c[-1] - c[0] for c in clocks) else None


def joined(tables: Sequence[Table], times: Sequence[Mapping[str, Any]]) -> Table:
    """Columns of all files of a run at the clock of the first, as a study reads them."""
    main = tables[0]
    columns, at = main.columns(), _seconds(main, times[0])
    for table, time in zip(tables[1:], times[1:], strict=True):
        clock = _seconds(table, time)
        for name in table.header:
            if name in columns or name == time["column"] or not table.is_number[name]:
                continue
            values = table.numbers(name)
            there = np.isfinite(values)
            columns[name] = (
                np.interp(at, clock[there], values[there], np.nan, np.nan)
                if there.any()
                else np.full(len(at), np.nan)
            )
    return Table.of_columns(main.path, columns)


def joined_layout(
    layouts: Sequence[TableLayout],
    times: Sequence[Mapping[str, Any]],
    tables: Sequence[Sequence[Table]],
    header: Sequence[str],
) -> TableLayout:
    """Columns of a joined table, as the headers of its files state them.

    Args:
        layouts: Columns of each kind of file.
        times: Keys of ``time`` for each kind.
        tables: Files of each kind, run by run.
        header: Columns that the joined table has.
    """
    columns: list[Column] = list(layouts[0].columns)
    for layout, time, own in zip(layouts[1:], times[1:], tables[1:], strict=True):
        known = {c.name for c in columns} | {time["column"]}
        further = (c for c in layout.columns if c.name in header and c.name not in known)
        columns += [replace(c, fill=_fill(c.name, own)) for c in further]
    return replace(layouts[0], columns=tuple(columns))


def _fill(name: str, tables: Sequence[Table]) -> str:
    """How a column goes on between its own samples, as far as its files show."""
    found = (table.numbers(name) for table in tables)
    return "hold" if rest_and_jump(values[np.isfinite(values)] for values in found) else "linear"


def share_columns(a: TableLayout, b: TableLayout) -> bool:
    """Whether two kinds of files have columns in common: then they are runs of one instrument.

    One in common may be the clock.
    """
    return len({c.name for c in a.columns if c.name} & {c.name for c in b.columns if c.name}) > 1


def _seconds(table: Table, time: Mapping[str, Any]) -> NDArray[np.float64]:
    factor = None if time["unit"] == "clock" else to_si(time["unit"]).factor
    return table.seconds(time["column"], factor, None)


__all__ = ["clocks_of", "joined", "joined_layout", "paired", "share_columns"]
