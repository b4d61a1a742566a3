"""Samples of one run: columns of its files on its clock, formulas of them, which rows are kept.

Facts of a run are numbers and labels, stated in the study or taken from its file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic import ValidationError

from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.schema import problem_lines
from diffsim.core.units import to_si
from diffsim.data.codes import unwrapped
from diffsim.data.decode import Decode
from diffsim.data.formula import evaluate
from diffsim.data.run_plan import filled
from diffsim.data.study import Run
from diffsim.data.study_schema import Fact, RunEntry, Source
from diffsim.data.table import Rows, Table, as_label

_SLACK_S = 1e-9  # times such as 0.30000000000000004 are 0.3


@dataclass(frozen=True, eq=False)
class RunSamples:
    """Rows of a run."""

    tables: Sequence[Table]  # the run's file, and those that are read at its clock
    clocks: Sequence[Array]  # clock of all rows of each, (num_rows,) [s]
    rows: Rows  # rows of the first file that the run has
    recorded_s: Array  # clock of the file at these rows, (num_samples,) [s]
    # clock of the run at these rows, (num_samples,) [s]
    time_s: Array = field(default_factory=lambda: np.empty(0))
    facts: Mapping[str, Any] = field(default_factory=dict)  # facts of the run by name
    # whether columns of further files keep their value until their next sample, averaged from row
    # to row; else they follow straight lines
    holds: bool = False
    decode: Decode | None = None  # how numbers of columns are coded; None: they are not

    @property
    def table(self) -> Table:
        """The run's own file."""
        return self.tables[0]

    def holding(self) -> RunSamples:
        """The same, columns of further files held until their next sample."""
        return replace(self, holds=True)

    def decoding(self, decode: Decode | None) -> RunSamples:
        """The same, with numbers of columns coded as stated."""
        return replace(self, decode=decode)

    def only(self, keep: Rows) -> RunSamples:
        """Some of the rows."""
        cut = self.time_s[keep] if len(self.time_s) else self.time_s
        return replace(self, rows=self.rows[keep], recorded_s=self.recorded_s[keep], time_s=cut)

    def place_of(self, name: str, file: int | None = None) -> int:
        """Which of the files holds a column, from 0: the one that is stated, else the first.

        Raises:
            ValueError: the stated file is none of the run's.
        """
        if file is not None:
            if file > len(self.tables):
                there = ", ".join(table.path.name for table in self.tables)
                raise ValueError(f"column {name}: file: {file}, but the run has {there}")
            return file - 1
        return next((k for k, table in enumerate(self.tables) if name in table.header), 0)

    def column(self, name: str, file: int | None = None) -> Array:
        """Numbers of a column, (num_samples,); of a further file, in between its samples.

        Args:
            name: Header of the column.
            file: Which of the run's files holds it, from 1; None: the first that has it.
        """
        place = self.place_of(name, file)
        values = self.tables[place].numbers(name)
        values = values if place else values[self.rows]
        values = values if self.decode is None else self.decode(values)
        if not place:
            return values
        there = np.isfinite(values)
        if not there.any():
            return np.full(len(self.rows), np.nan)
        between = _hold_last_sample if self.holds else _interpolate_straight
        return between(self.recorded_s, self.clocks[place][there], values[there])

    def formula(
        self,
        text: str,
        channels: Mapping[str, Callable[[], Array]] = MappingProxyType({}),
        file: int | None = None,
    ) -> Array:
        """Samples of a formula, (num_samples,).

        Args:
            text: Formula of columns, facts and the clock.
            channels: What makes further names' samples; a column of that name goes first.
            file: Which of the run's files holds the columns, from 1; None: the first that has each.
        """
        numbers = [k for k, v in self.facts.items() if isinstance(v, (int, float))]
        columns = [name for table in self.tables for name in table.header]
        clock = self.time_s if len(self.time_s) else self.recorded_s

        def value_of(name: str) -> Array | float:
            if name in numbers:
                return float(self.facts[name])
            return self.column(name, file) if name in columns else channels[name]()

        try:
            return evaluate(text, clock, value_of, dict.fromkeys([*columns, *numbers, *channels]))
        except ValueError as error:
            raise ValueError(f"{self.table.path}: {error}") from None


def _interpolate_straight(at: Array, clock: Array, values: Array) -> Array:
    """Values on straight lines between samples; NaN beyond them, but for rounding."""
    near = np.clip(at, clock[0], clock[-1])
    slack = np.maximum(_SLACK_S, 4.0 * np.spacing(np.abs(near)))
    at = np.where(np.abs(at - near) <= slack, near, at)
    return np.interp(at, clock, values, left=np.nan, right=np.nan)


def _hold_last_sample(at: Array, clock: Array, values: Array) -> Array:
    """What is held until its next sample, on average from each row to the next; NaN before it.

    A command that comes shortly after a row acts nearly until the next one. The value at the row
    itself is an interval old.
    """
    at, clock = at - clock[0], clock - clock[0]  # seconds since 1970 would round
    end = np.append(at[1:], at[-1:])
    start = np.maximum(at, 0.0)
    last = np.maximum(np.searchsorted(clock, start + _SLACK_S, side="right") - 1, 0)
    until = np.maximum(np.searchsorted(clock, end - _SLACK_S, side="right") - 1, 0)
    held = np.where((at < -_SLACK_S) & (end <= 0.0), np.nan, values[last])
    jumps = np.append(0.0, np.diff(values))
    height, moment = np.cumsum(jumps), np.cumsum(jumps * clock)
    later = end * (height[until] - height[last]) - (moment[until] - moment[last])
    changes = (until > last) & (end > start)
    return held + np.where(changes, later / np.where(changes, end - start, 1.0), 0.0)


def in_si(raw: Array, source: Source, unit: str | None) -> Array:
    """Samples of a file in SI units; those that are in SI units stay as they are."""
    if source.scale != 1.0 or source.offset != 0.0:
        raw = source.scale * raw + source.offset
    if source.unwrap is not None:
        raw = unwrapped(raw, source.unwrap)
    if unit is None:
        return raw
    si = to_si(unit)
    return raw if (si.factor, si.offset) == (1.0, 0.0) else si.factor * raw + si.offset


def unfilled(values: Array, time_s: Array, fill: str | float, factor: float) -> Array:
    """A command without gaps: held, interpolated, or with a number in them."""
    there = np.flatnonzero(np.isfinite(values))
    if not isinstance(fill, str):
        return np.where(np.isfinite(values), values, factor * fill)
    if not len(there):
        return values
    if fill == "linear":
        return np.interp(time_s, time_s[there], values[there])
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    return np.asarray(values[np.where(last < 0, there[0], last)])


def _of_run(stated: float | Mapping[str, float] | None, labels: Sequence[str]) -> float | None:
    """A number that may be stated by run."""
    if isinstance(stated, Mapping):
        return next((stated[label] for label in labels if label in stated), None)
    return stated


def zero_of(
    entry: RunEntry,
    samples: RunSamples,
    labels: Sequence[str],
    where: str,
    channels: Mapping[str, Callable[[], Array]],
) -> float:
    """Time of the file that becomes 0 s.

    Args:
        entry: Entry of ``runs:``, with defaults.
        samples: All samples of the run, on the clock of the file.
        labels: What the run is called where a number is stated by run.
        where: What messages call the entry.
        channels: What makes a channel's samples, in SI units, by its name.
    """
    if entry.zero_when is not None:
        true = samples.formula(entry.zero_when, channels) > 0.0
        if not true.any():
            raise ValueError(f"{where}.zero_when: {entry.zero_when!r} is never true")
        return float(samples.recorded_s[int(np.argmax(true))])
    if entry.zero_time == "start":
        keep = _window(entry, samples.recorded_s, labels)
        return float(samples.recorded_s[int(np.argmax(keep))])
    assert not isinstance(entry.zero_time, str)
    return _of_run(entry.zero_time, labels) or 0.0


def _window(entry: RunEntry, recorded_s: Array, labels: Sequence[str]) -> Mask:
    keep = np.ones(len(recorded_s), dtype=bool)
    if (start := _of_run(entry.from_s, labels)) is not None:
        keep &= recorded_s >= start - _SLACK_S
    if (end := _of_run(entry.until_s, labels)) is not None:
        keep &= recorded_s < end - _SLACK_S
    return keep


def kept_rows(entry: RunEntry, samples: RunSamples, labels: Sequence[str], where: str) -> Rows:
    """Indices of the samples in the windows of a run; with ``every``, of each n-th of them.

    Raises:
        ValueError: nothing is left.
    """
    keep = _window(entry, samples.recorded_s, labels)
    if entry.before_zero_s is not None:
        keep &= samples.time_s >= -entry.before_zero_s - _SLACK_S
    if entry.after_zero_s is not None:
        keep &= samples.time_s < entry.after_zero_s - _SLACK_S
    rows = np.flatnonzero(keep)
    if not len(rows):
        first, last = samples.recorded_s[0], samples.recorded_s[-1]
        raise ValueError(
            f"{where}: no sample of {labels[0]} is left by from_s, until_s and the like; "
            f"{samples.table.path.name} lasts from {first:g} to {last:g} s"
        )
    if entry.average or entry.every == 1:
        return rows
    if isinstance(entry.every, int):
        return rows[:: entry.every]
    step = np.ones(len(rows), dtype=int)
    for start, n in sorted(entry.every.items()):
        step[samples.time_s[rows] >= start - _SLACK_S] = n
    kept, until_next = [], 0
    for row, n in zip(rows, step, strict=True):
        until_next = min(until_next, int(n) - 1)
        if until_next <= 0:
            kept.append(int(row))
            until_next = int(n)
        until_next -= 1
    return np.array(kept)


def averaged(run: Run, every: int | Mapping[float, int]) -> Run:
    """Means over each n samples of a run."""
    n = every if isinstance(every, int) else max(every.values())
    return replace(run, raw={}).mapped(lambda values: _mean(values, n))


def _mean(values: Array, n: int) -> Array:
    """Means over n rows, gaps left out; a rest of fewer rows is left out."""
    whole = values[: len(values) // n * n].reshape(-1, n, *values.shape[1:])
    count = np.isfinite(whole).sum(axis=1)
    total = np.nansum(whole, axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def mean_of_equal(run: Run) -> Run:
    """Rows of a run with equal stamps averaged into one; gaps are left out."""
    first = np.flatnonzero(np.append(True, np.diff(run.time_s) != 0.0))

    def mean(values: Array) -> Array:
        there = np.isfinite(values)
        count = np.add.reduceat(there.astype(np.float64), first, axis=0)
        total = np.add.reduceat(np.where(there, values, 0.0), first, axis=0)
        return np.where(count > 0.0, total / np.maximum(count, 1.0), np.nan)

    return replace(run.mapped(mean), time_s=run.time_s[first])


def without_gaps(run: Run) -> Run:
    """A run whose lost rows are put back: commands on straight lines, nothing measured."""
    steps = np.diff(run.time_s)
    if not len(steps):
        return run
    usual = float(np.median(steps))
    return with_rows_back(run, np.maximum(np.round(steps / usual).astype(np.int64) - 1, 0))


def with_rows_back(run: Run, lost: IntArray, *, is_measured: bool = False) -> Run:
    """A run with so many rows put back behind each row: commands on straight lines, nothing
    measured.

    Args:
        lost: (num_samples - 1,).
        is_measured: Readings are on straight lines, too, for a simulator that plays them.
    """
    if not lost.any():
        return run
    steps = np.diff(run.time_s)
    at = np.append(np.repeat(np.arange(len(steps)), lost + 1), len(steps))  # row before, or itself
    first = np.append(0, np.cumsum(lost + 1))
    place = np.arange(len(at)) - first[at]
    whole = np.append(lost + 1, 1)
    share = place / whole[at]
    time_s = run.time_s[at] + share * np.append(steps, 0.0)[at]
    is_new = place > 0

    def on_line(values: Array) -> Array:
        return np.where(is_new, np.interp(time_s, run.time_s, values), values[at])

    def on_lines(values: Array) -> Array:
        return np.stack([on_line(column) for column in values.T], axis=1)

    def without(values: Array) -> Array:
        out = values[at].copy()
        out[is_new] = np.nan
        return out

    return replace(
        run,
        time_s=time_s,
        measured=on_lines(run.measured) if is_measured else without(run.measured),
        command={name: on_line(values) for name, values in run.command.items()},
        columns={name: on_line(values) for name, values in run.columns.items()},
        raw={name: (header, without(values)) for name, (header, values) in run.raw.items()},
    )


def facts_of(
    setup: Mapping[str, Any], samples: RunSamples, words: Mapping[str, str], where: str
) -> dict[str, Any]:
    """Facts of a run, in SI units.

    Args:
        setup: As the study states them.
        words: What {name} stands for in texts.
        where: What messages call it, such as "runs[2].setup".

    Raises:
        ValueError: a fact that cannot be read, or a column that is not constant.
    """
    return {name: _fact(f"{where}.{name}", name, v, samples, words) for name, v in setup.items()}


def _fact(where: str, name: str, stated: Any, samples: RunSamples, words: Mapping[str, str]) -> Any:
    if stated == "column":
        stated = {}
    if isinstance(stated, bool) or stated is None:
        raise ValueError(f"{where} must be a number, a label or a mapping, got {stated!r}")
    if isinstance(stated, (int, float)):
        return float(stated)
    if isinstance(stated, str):
        return _as_fact(filled(stated, words, where))
    try:
        fact = Fact.model_validate(stated)
    except ValidationError as error:
        raise ValueError("\n".join(problem_lines(where, error))) from None
    si = to_si(fact.unit)
    if fact.value is not None:
        value = fact.value if isinstance(fact.value, float) else filled(fact.value, words, where)
        value = _as_fact(value) if isinstance(value, str) else value
        if isinstance(value, str) and fact.unit != "-":
            raise ValueError(f"{where} must be a number in {fact.unit}, got {value!r}")
        return value if isinstance(value, str) else si.factor * value + si.offset
    if fact.formula is not None:
        values = samples.formula(fact.formula)
    else:
        column = fact.column or name
        table = samples.tables[place := samples.place_of(column)]
        table.require(column)
        if not table.is_number[column]:
            return _label(where, column, table, samples.rows if not place else range(len(table)))
        values = samples.column(column)
    return si.factor * _take_number(where, values, fact.take) + si.offset


def _as_fact(text: str) -> float | str:
    label = as_label(text)
    return label if isinstance(label, str) else float(label)


def _label(where: str, column: str, table: Table, rows: Iterable[int]) -> str:
    cells = table.texts(column)
    found = list(dict.fromkeys(cells[i] for i in rows))
    if len(found) > 1:
        raise ValueError(
            f"{where}: column {column} of {table.path.name} is not constant in the run: "
            f"{', '.join(found[:5])}"
        )
    return found[0]


def _take_number(where: str, values: np.ndarray, take: str) -> float:
    there = values[np.isfinite(values)]
    if not len(there):
        raise ValueError(f"{where}: all cells are empty")
    if take == "first":
        return float(there[0])
    if take == "last":
        return float(there[-1])
    if take == "constant" and np.ptp(there) > 1e-9 * max(abs(float(there[0])), 1e-300):
        raise ValueError(
            f"{where}: the column is not constant in the run, it goes from {there.min():g} to "
            f"{there.max():g}; say take: first, last or mean"
        )
    return float(there[0]) if take == "constant" else float(np.mean(there))
