"""Stamps of rows that cannot be right: equal, missing, reversed, set while they were written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from diffsim.core.arrays import Array, IntArray
from diffsim.core.figures import counted
from diffsim.core.schema import Part
from diffsim.data.study_types import Number

MAX_LOST = 100_000  # rows
JUMP = 100.0  # usual steps, from which on a clock may have been set


class Stamps(Part):
    """What is done to stamps of rows that cannot be right."""

    missing: Literal["line", "drop"] | None = Field(
        None, description="Rows without a stamp: on a line between their neighbors, or left out"
    )
    backward: Literal["sort", "drop"] | None = Field(
        None, description="Rows whose stamp goes back: sorted by it, or left out"
    )
    jumps: Literal["close"] | None = Field(
        None, description="Jumps of the clock, such as by an hour, become one usual step"
    )
    drift: Number | None = Field(
        None,
        description="Parts per million by which the clock of further files runs faster than that "
        "of the first",
    )
    lost_rows: dict[int, int] = Field(
        {},
        description="Rows that are lost, by the number of rows before them, where the clock counts "
        "rows: {152: 3}",
    )

    @field_validator("lost_rows")
    @classmethod
    def _plausible(cls, given: Mapping[int, int]) -> Mapping[int, int]:
        for row, count in given.items():
            if row < 1 or not 1 <= count <= MAX_LOST:
                raise ValueError(f"must be rows and counts above 0, got {row}: {count}")
        return given

    @property
    def words(self) -> str:
        """What is done, for messages."""
        said = [
            self.missing
            and {"line": "stamps on lines", "drop": "rows without a stamp left out"}[self.missing],
            self.backward
            and {"sort": "rows sorted", "drop": "rows that go back left out"}[self.backward],
            self.jumps and "jumps of the clock closed",
            self.drift and f"further files' clock slowed by {self.drift:g} ppm",
            self.lost_rows and f"{sum(self.lost_rows.values())} lost rows counted",
        ]
        return ", ".join(str(s) for s in said if s)

    def leaving_out(self) -> Stamps:
        """The same, rows that have no stamp of their own left out where nothing else is stated."""
        kept = {"missing": self.missing or "drop", "backward": self.backward or "drop"}
        return self.model_copy(update=kept)


Duplicates = Literal["first", "last", "mean", "spread"]


def mended(clock: Array, stamps: Stamps, duplicates: Duplicates | None) -> tuple[IntArray, Array]:
    """Rows that stay, in order, and their stamps [s].

    Args:
        clock: Stamps of the rows, (num_rows,) [s]; NaN where they are missing.
        stamps: What is done to those that cannot be right.
        duplicates: What is done to equal ones; of ``mean``, the caller averages the rows.
    """
    rows = np.arange(len(clock))
    now = np.array(clock, dtype=np.float64)
    if stamps.lost_rows:
        later, step = np.zeros(len(now)), usual_step(now)
        for row, count in stamps.lost_rows.items():
            later[row:] += count * step
        now = now + later
    there = np.isfinite(now)
    if stamps.missing == "line" and there.any():
        now = on_a_line(now)
    elif stamps.missing == "drop":
        rows, now = rows[there], now[there]
    if stamps.jumps == "close":
        now = closed(now)
    if stamps.backward == "sort":
        order = np.argsort(now, kind="stable")
        rows, now = rows[order], now[order]
    elif stamps.backward == "drop":
        latest = np.maximum.accumulate(np.where(np.isfinite(now), now, -np.inf))
        rows, now = rows[now >= latest], now[now >= latest]
    if duplicates == "spread":
        now = spread(now)
    elif duplicates is not None and len(now):
        new = np.append(True, np.diff(now) != 0.0)
        first = np.flatnonzero(new)
        chosen = first if duplicates != "last" else np.append(first[1:] - 1, len(now) - 1)
        rows, now = rows[chosen], now[chosen]
    return rows, now


def of_further(clock: Array, stamps: Stamps, duplicates: Duplicates | None) -> Array:
    """Clock of a further file, (num_rows,) [s]: all its rows stay, as they are only looked up."""
    now = np.array(clock, dtype=np.float64)
    if stamps.missing is not None and np.isfinite(now).any():
        now = on_a_line(now)
    if stamps.jumps == "close":
        now = closed(now)
    if duplicates == "spread":
        now = spread(now)
    if stamps.drift:
        now = now[0] + (now - now[0]) / (1.0 + 1e-6 * stamps.drift)
    return now


def usual_step(clock: Array) -> float:
    """Median of the steps that go on [s]; 0 of none."""
    steps = np.diff(clock[np.isfinite(clock)])
    steps = steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else 0.0


def on_a_line(clock: Array) -> Array:
    """A clock whose missing stamps lie between their neighbors; beyond them, in usual steps."""
    there = np.flatnonzero(np.isfinite(clock))
    rows, step = np.arange(len(clock)), usual_step(clock)
    out = np.interp(rows, there, clock[there])
    out = np.where(rows < there[0], clock[there[0]] + step * (rows - there[0]), out)
    return np.where(rows > there[-1], clock[there[-1]] + step * (rows - there[-1]), out)


def closed(clock: Array) -> Array:
    """A clock without jumps: those of hundreds of steps, or back by more than one row moves."""
    step = usual_step(clock)
    if not step > 0.0 or len(clock) < 3:
        return clock
    steps = np.diff(clock)
    off = np.abs(steps - step) > JUMP * step
    return clock[0] + np.append(0.0, np.cumsum(np.where(off, step, steps)))


def spread(clock: Array) -> Array:
    """A clock whose equal stamps are spread evenly until the next one."""
    new = np.flatnonzero(np.append(True, np.diff(clock) != 0.0))
    if len(new) == len(clock) or len(new) < 2:
        return clock
    counts = np.diff(np.append(new, len(clock)))
    ends = np.append(clock[new[1:]], 2.0 * clock[new[-1]] - clock[new[-2]])
    share = (np.arange(len(clock)) - np.repeat(new, counts)) / np.repeat(counts, counts)
    start = np.repeat(clock[new], counts)
    return start + share * (np.repeat(ends, counts) - start)


def filled(now: Array) -> int:
    """Rows before the last ones that a program did not fill: their stamps are all back at zero.

    Args:
        now: Stamps of the rows, (num_rows,), in any unit.
    """
    if len(now) < 2 or now[-1] != 0.0 or not now[0] >= 0.0:
        return len(now)
    written = np.flatnonzero(now)
    return int(written[-1]) + 1 if len(written) else len(now)


def stamp_fault(now: Array) -> tuple[int, str, str] | None:
    """The first row whose stamp does not follow the one before it, why, and what mends it.

    Args:
        now: Stamps of the rows, (num_rows,) [s]; NaN where they are missing.
    """
    if np.isnan(now).any():
        at = int(np.argmax(np.isnan(now)))
        return at, "time is missing", "`stamps: {missing: line}` puts it between its neighbors"
    steps = np.diff(now)
    wrong = steps <= 0.0
    if not wrong.any():
        return None
    num = filled(now)
    if num < len(now) and not wrong[: num - 1].any():
        said = f"the clock is 0 from here to the end, {counted(len(now) - num, 'row')}"
        remedy = "`stamps: {backward: drop}` leaves them out"
        return num, f"{said}: they were not filled", remedy
    at = int(np.argmax(wrong)) + 1
    usual, back = usual_step(now), np.flatnonzero(steps < 0.0)
    said = f"time must increase, got {now[at]:g} s after {now[at - 1]:g} s"
    if not len(back):
        pairs = int((steps == 0.0).sum())
        said += f" ({counted(pairs, 'equal stamp')})"
        return (
            at,
            said,
            (
                "`duplicates: first`, `last` or `mean` keeps one row of each; `duplicates: spread` "
                "keeps all, where rows came faster than the clock counts"
            ),
        )
    far = -steps[back] > JUMP * usual
    if far.all() and usual > 0.0:
        return (
            at,
            f"{said}: the clock was set back or began anew",
            ("`stamps: {jumps: close}` goes on by the usual step; or split it into runs"),
        )
    return (
        at,
        f"{said}: rows are out of order",
        ("`stamps: {backward: sort}` sorts them, `{backward: drop}` leaves them out"),
    )


def stamp_words(path: object, lines: Sequence[int], now: Array, column: str) -> str | None:
    """Why the stamps of rows cannot be right, at which row, and what mends it; None: they can.

    Args:
        path: File, for the message.
        now: Their stamps, (num_rows,) [s].
    """
    if (fault := stamp_fault(now)) is None:
        return None
    at, why, remedy = fault
    return f"{path}, row {lines[at]}, column {column}: {why}; {remedy}"
