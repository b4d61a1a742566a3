"""Rows of a run that were written twice: each row, or a stretch that a logger flushed again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from diffsim.core.arrays import Array, Mask
from diffsim.data.record.finding import Finding
from diffsim.data.record.signals import Record
from diffsim.data.shared_rows import SHARED_BITS, STRETCH, bits_of

EACH = 0.9  # of every second row, that equals the one before: each was written twice
LEAP = 4.0  # usual changes, by which a record leaps back where a stretch begins again


def find_doubled(record: Record) -> Iterator[Finding]:
    """Runs with rows that stand twice, in all of their columns."""
    for run in record.study.runs:
        columns = [*run.measured.T, *(v for v in run.command.values() if len(v) == len(run.time_s))]
        if not columns:
            continue
        rows = np.column_stack(columns)
        if len(rows) < 4 * STRETCH:
            continue
        equal = ((rows[1:] == rows[:-1]) | np.isnan(rows[1:])).all(axis=1)
        if _is_each_twice(equal):
            yield Finding(
                f"run {run.name}",
                f"each of its rows stands twice, {len(rows) // 2} were measured",
                f"every second row is to go; where stamps count rows, so is half of the time: mend "
                f"the file of run {run.name}",
                True,
            )
        elif (found := _again(rows)) is not None:
            first, second, count = found
            start, again = float(run.time_s[first]), float(run.time_s[second])
            yield Finding(
                f"run {run.name}",
                f"its {count} rows from {start:.6g} s stand again from {again:.6g} s on, in all "
                "columns: they were written twice",
                f"mend the file, or `until_s: {again:.6g}` in run {run.name} ends before row "
                f"{second + 1}",
                True,
            )


def _is_each_twice(equal: Mask) -> bool:
    """Whether every second row equals the one before, and no other does.

    Args:
        equal: Whether a row equals the one before, (num_rows - 1,).
    """
    shares = sorted(float(equal[phase::2].mean()) for phase in (0, 1))
    return shares[1] > EACH and shares[0] < 1.0 - EACH


def _again(rows: Array) -> tuple[int, int, int] | None:
    """First row of a stretch, row where the same begins again at its end, and its length."""
    there = np.isfinite(rows).all(axis=1)
    sums = np.zeros(len(rows))
    for k, values in enumerate(rows.T):  # equal rows have equal sums, others hardly ever
        sums += np.where(there, values, np.nan) * np.sqrt(k + 2.0)
    order = np.argsort(sums, kind="stable")
    same = sums[order][1:] == sums[order][:-1]
    lags = (order[1:] - order[:-1])[same]
    lag = int(np.bincount(lags).argmax()) if len(lags) else 0
    if lag < STRETCH:
        return None
    at = np.flatnonzero((rows[lag:] == rows[:-lag]).all(axis=1))  # the row lag before the copy
    for part in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
        first, count = int(part[0]), len(part)
        second = first + lag
        # a motion that repeats goes on without a leap, and longer or shorter than its period
        if count == lag and bits_of(rows[second : second + count]) > SHARED_BITS:
            leap = np.abs(rows[second] - rows[second - 1])
            usual = np.median(np.abs(np.diff(rows, axis=0)), axis=0)
            if (leap > LEAP * usual).any():
                return first, second, count
    return None
