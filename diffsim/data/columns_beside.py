"""Columns of run files that no channel, command, clock or fact uses: what is left may follow them.

A temperature or a supply voltage is often recorded and not modeled. What tells nothing new is left
out: text, constants, clocks, copies of another column, and what a run lacks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from keyword import kwlist

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.expression import CONSTANTS, FUNCTIONS
from diffsim.core.units import to_si
from diffsim.data.formula import CLOCK
from diffsim.data.names import COUNTER, may_be_time
from diffsim.data.run_samples import RunSamples, in_si, unfilled
from diffsim.data.study import Column, Run, Study
from diffsim.data.study_schema import Source
from diffsim.data.table import Rows
from diffsim.data.table_guess import TIME, column_of

_WORDS = {CLOCK, "nan", *CONSTANTS, *FUNCTIONS, *kwlist}  # of formulas: no names of columns
_AS_IS = Source()  # as the file has it
_EVEN = 0.5  # of the usual step: a clock varies by less, as for diffsim.data.clock_guess
_UNTOLD_SHARE = 0.1  # of a column's squares, that channels leave of an output
_DIGITS = 6  # of the range, in which copies agree: one in mm and one in m differ by rounding


def numeric_columns(samples: RunSamples, keep: Rows | slice = slice(None)) -> dict[str, Array]:
    """All columns of a run that hold numbers, by header, without gaps: (num_samples,) each."""
    samples, found = replace(samples, tables=[table.twin() for table in samples.tables]), {}
    for header in dict.fromkeys(name for table in samples.tables for name in table.header if name):
        try:
            values = samples.column(header)
        except ValueError:  # text or infinite, which nobody asked for
            continue
        if np.isfinite(values).any():
            found[header] = unfilled(values, samples.time_s, "linear", 1.0)[keep]
    return found


def choose_columns(
    runs: Sequence[Run],
    used: Collection[str],
    taken: Collection[str],
    unit_cells: Mapping[str, str],
) -> tuple[tuple[Run, ...], tuple[Column, ...]]:
    """The columns that may explain something, in SI units, under names that formulas can use.

    Args:
        runs: Runs with all numeric columns of their files, by header.
        used: Headers that the study uses.
        taken: Names of channels, commands and facts.
        unit_cells: Of files with a row of units, what stands there, by header.

    Returns:
        The runs with these columns alone, and what is known of each.
    """
    names = _WORDS | set(taken)
    columns, units = [], {}
    for header in _headers_that_tell(runs, used):
        said = column_of(header, unit_cells.get(header, ""))
        name = next(n for n in _count_up(said.base) if n not in names)
        names.add(name)
        units[header] = said.unit
        columns.append(Column(name, said.unit and to_si(said.unit).unit, header))

    given = [
        {c.name: in_si(run.columns[c.header], _AS_IS, units[c.header]) for c in columns}
        for run in runs
    ]
    pairs = zip(runs, given, strict=True)
    return tuple(replace(run, columns=in_si_units) for run, in_si_units in pairs), tuple(columns)


def outputs_of(study: Study) -> frozenset[str]:
    """Columns beside that are outputs of the experiment, such as another marker of the same leg.

    The channels of one unit tell them row by row: what is left of a channel follows such a column
    by itself, and nothing acts through it. Channels of several units would tell an input, too, by
    the model turned round.

    Args:
        study: Study with columns beside; its test runs are not looked at.
    """
    runs = study.fit_runs or study.runs
    measured = np.concatenate([run.measured for run in runs])
    units = np.array([channel.unit for channel in study.channels])
    found = []
    for column in study.columns:
        values = np.concatenate([run.columns[column.name] for run in runs])
        alike = dict.fromkeys(u for u in units if column.unit in (None, u))
        if any(_is_told(values, measured[:, units == unit]) for unit in alike):
            found.append(column.name)
    return frozenset(found)


def _is_told(values: Array, rows: Array) -> bool:
    """Whether a line through each row of channels tells a column, but for a small share."""
    seen = np.isfinite(rows).all(axis=1) & np.isfinite(values)
    if not seen.sum() > rows.shape[1] + 1:
        return False
    given = np.column_stack([np.ones(seen.sum()), rows[seen]])
    told = given @ np.linalg.lstsq(given, values[seen], rcond=None)[0]
    return bool(np.var(values[seen] - told) < _UNTOLD_SHARE * np.var(values[seen]))


def _headers_that_tell(runs: Sequence[Run], used: Collection[str]) -> Iterator[str]:
    """Unused headers of all runs whose numbers are no constant, no clock and no copy.

    Numbers of test runs choose nothing.
    """
    common = [h for h in runs[0].columns if all(h in r.columns for r in runs)] if runs else []
    seen = [run for run in runs if run.use != "test"] or runs
    shapes = {_shape([r.columns[h] for r in seen]) for h in common if h in used} | {None}
    for header in (h for h in common if h not in used):
        shape = _shape([r.columns[header] for r in seen])
        if shape not in shapes and not _is_clock(header, seen):
            shapes.add(shape)
            yield header


def _shape(values: Sequence[Array]) -> bytes | None:
    """What copies of a column in any unit share; None of a constant."""
    joined = np.concatenate(values)
    low, high = joined.min(), joined.max()
    if not high > low:
        return None
    return np.round((joined - low) / (high - low), _DIGITS).tobytes()


def _is_clock(header: str, runs: Sequence[Run]) -> bool:
    """Whether a column counts rows or seconds: never back by its name, or on by even steps."""
    said = column_of(header)
    steps = np.concatenate([np.diff(run.columns[header]) for run in runs])
    if not may_be_time(said) or not len(steps) or (steps < 0.0).any():
        return False
    if TIME.match(said.base) or COUNTER.match(said.base):
        return True
    rates = steps / np.concatenate([np.diff(run.time_s) for run in runs])
    return any(np.ptp(by) < _EVEN * np.median(by) for by in (steps, rates))


def _count_up(name: str) -> Iterator[str]:
    """A name, then name_2, name_3 and so on."""
    yield name
    number = 2
    while True:
        yield f"{name}_{number}"
        number += 1
