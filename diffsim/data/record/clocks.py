"""Rows and their times: lost rows, clocks that were set, clocks of two files that run apart."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path

import numpy as np

from diffsim.core.figures import counted
from diffsim.data.record.finding import Finding, rows_shown
from diffsim.data.record.signals import FEW, Record, Samples, Signal
from diffsim.data.signal import COMMAND_JUMP, GAP
from diffsim.data.stamps import JUMP
from diffsim.data.study import Run
from diffsim.data.table import Table

NEVER = 1e7  # usual steps: no run pauses that long
LEAST_MOVED = 0.1  # of a command's range, in a gap
TIMELESS = ("bench",)  # systems without a state
HOUR = 3600.0  # s
SMOOTH = 0.7  # share of the rows at which what is swept changes
LOST_JUMP = 3.0  # largest changes around, beyond which rows were lost
TAPS = 20  # samples of a command that a channel follows
EARLY = 4  # samples by which a command may seem late
MOST_PAIRS = 6  # of commands and channels of a run
LEAST_DRIFT = 20.0  # parts per million
BETTER = 0.7  # share of the squares that are left with a drift


def find_stamps(record: Record) -> Iterator[Finding]:
    """Stamps that are missing, equal or go back: rows with them were not read."""
    for run, says in record.study.stamps:
        yield Finding(f"run {run}", says, "", True)


def find_gaps(record: Record) -> Iterator[Finding]:
    """Rows that are lost while a command moves, and clocks that were set."""
    system, held = (record.study.model or {}).get("system"), _find_held(record)
    for run in record.study.runs if system not in TIMELESS else ():
        steps = np.diff(run.time_s)
        if len(steps) < FEW or not (steps > 0.0).all():
            continue
        usual = float(np.median(steps))
        long = np.flatnonzero(steps > GAP * usual)
        was_set = [int(k) for k in long if _was_set(record, run, int(k), usual)]
        if was_set:
            times = [float(run.time_s[k]) for k in was_set]
            yield Finding(
                f"run {run.name}",
                f"its clock jumps by {steps[was_set[0]]:.6g} s, {rows_shown(times)}: it was set "
                "there, as all goes on",
                f"`stamps: {{jumps: close}}` in run {run.name} goes on by the usual step",
                True,
            )
            continue
        moved = [(k, c) for k in long if (c := _moving(record, run, int(k))) in held]
        if moved and len(moved) < 0.1 * len(steps):
            k, command = moved[0]
            lost = round(float(steps[k] / usual)) - 1
            times = [float(run.time_s[j]) for j, _ in moved]
            yield Finding(
                f"run {run.name}",
                f"rows are lost while command {command} moves, {lost} of them at "
                f"{run.time_s[k]:.6g} s ({counted(len(moved), 'gap')}, "
                f"{rows_shown(times)}): what it was meanwhile is not known",
                f"`gaps: line` in run {run.name} takes a line between its neighbors",
                lost >= 2,
            )


def _find_held(record: Record) -> set[str]:
    """Commands of inputs that the model holds from sample to sample: over a gap that is wrong."""
    inputs = (record.study.model or {}).get("inputs") or ()
    stated = [i for i in inputs if isinstance(i, dict) and i.get("held")]
    words = " ".join(str(value) for i in stated for value in i.values())
    return {c.name for c in record.commands if c.name in re.findall(r"\w+", words)}


def _was_set(record: Record, run: Run, k: int, usual: float) -> bool:
    """Whether a long step is a clock that was set, and no pause."""
    step = float(run.time_s[k + 1] - run.time_s[k])
    if step < JUMP * usual:
        return False
    if step > NEVER * usual:
        return True
    hours = (step - usual) / HOUR
    if round(hours) >= 1 and abs(hours - round(hours)) * HOUR < 2.0 * usual:
        return True
    if step < 60.0:
        return False
    moving = goes_on = 0
    for signal in record.signals:
        samples = signal.of_run(run.name)
        if samples is None or len(samples) != len(run.time_s) or not signal.range > 0.0:
            continue
        around = samples.around(k, 4)
        if np.abs(around).min(initial=np.inf) > 4.0 * samples.noise:
            moving += 1
            goes_on += abs(samples.changes[k]) < 2.0 * np.abs(around).max()
    return moving > 0 and goes_on == moving


def _moving(record: Record, run: Run, k: int) -> str | None:
    """A command that is swept over a gap, by more than between other rows."""
    for command in record.commands:
        samples = command.of_run(run.name)
        if samples is None or len(samples) != len(run.time_s) or not command.range > 0.0:
            continue
        moved, around = abs(samples.changes[k]), np.abs(samples.around(k, 5))
        if not len(around) or np.mean(around > 0.0) <= SMOOTH:
            continue
        least = max(LEAST_MOVED * command.range, COMMAND_JUMP * float(np.median(around)))
        if moved > least:
            return command.name
    return None


def find_unstamped(record: Record) -> Iterator[Finding]:
    """Rows that are lost where the clock counts rows: all that moves jumps at once."""
    for run in record.study.runs:
        steps = np.diff(run.time_s)
        if len(steps) < 40 or np.ptp(steps) > 1e-6 * float(np.median(steps)):
            continue  # stamps would show it
        of = [
            (s, x)
            for s in record.signals
            if (x := s.of_run(run.name)) is not None
            and len(x) == len(run.time_s)
            and x.range > 0.02 * s.range > 0.0
        ]
        if (found := _lost_at(of)) is None:
            continue
        k, count, names = found
        yield Finding(
            f"run {run.name}",
            f"{', '.join(names)} jump together after row {k + 1} ({run.time_s[k]:.6g} s), and "
            f"nowhere else: about {count} rows are lost there",
            f"`stamps: {{lost_rows: {{{k + 1}: {count}}}}}` in run {run.name} counts them",
            True,
        )


def _lost_at(of: Sequence[tuple[Signal, Samples]]) -> tuple[int, int, list[str]] | None:
    swept = [
        (s, x)
        for s, x in of
        if s.role == "command"
        and np.mean(x.changes != 0.0) > SMOOTH
        and x.noise < 0.1 * x.usual_change
        and _is_smooth(x)
    ]
    if not swept or not any(s.role == "channel" for s, _ in of):
        return None
    signal, lead = max(swept, key=lambda pair: pair[1].largest_change / pair[0].range)
    k = int(np.argmax(np.abs(lead.changes)))
    if not 6 < k < len(lead.changes) - 6:
        return None
    around = np.abs(lead.around(k, 5))
    if abs(lead.changes[k]) < LOST_JUMP * around.max():
        return None
    names = [signal.name]
    for s, x in of:
        if s is signal:
            continue
        jump, usual = abs(x.changes[k]), float(np.abs(x.around(k, 5)).max())
        if jump > max(2.0 * usual, 6.0 * x.noise):
            names.append(s.name)
        elif s.role == "command" and np.median(np.abs(x.around(k, 5))) > 0.0:
            return None  # one that moves and goes on
    if not any(s.role == "channel" and s.name in names for s, _ in of):
        return None
    return k, _count_lost(lead, k), names


def _is_smooth(samples: Samples) -> bool:
    """Whether no change but the largest is one of a jump."""
    change = np.abs(samples.changes)
    k = int(np.argmax(change))
    rest = np.delete(change, k)
    return bool(rest.max() < 0.6 * change[k])


def _count_lost(samples: Samples, k: int) -> int:
    """How many rows make a jump, at the pace before and after it."""
    before = float(np.mean(samples.changes[k - 2 : k]))
    after = float(np.mean(samples.changes[k + 1 : k + 3]))
    pace = 0.5 * (before + after)
    if abs(pace) < 1e-300:
        return 1
    return max(1, round(abs(float(samples.changes[k]) / pace)) - 1)


def find_drift(record: Record) -> Iterator[Finding]:
    """Clocks of a run's files that run apart."""
    found = []
    for run in record.study.runs:
        if len(run.files) < 2 or run.use == "test":
            continue
        first = _columns_of_first(run)
        for command, channel in list(product(record.commands, record.channels))[:MOST_PAIRS]:
            y, u = channel.of_run(run.name), command.of_run(run.name)
            sign = _of_further(first, command, channel)
            if sign and y is not None and u is not None and len(y) > 8 * TAPS and u.range > 0.0:
                drift = _drift(y, u)
                found.append(None if drift is None else sign * drift)
    drifts = np.array([drift for drift in found if drift is not None])
    if len(drifts) < max(2, 0.4 * len(found)):
        return
    middle = float(np.median(drifts))
    if abs(middle) < LEAST_DRIFT or np.mean(np.abs(drifts - middle) < 0.3 * abs(middle)) < 0.6:
        return
    yield Finding(
        "study",
        f"clocks of the files of a run run apart, by {middle:.3g} parts per million in "
        f"{len(drifts)} places: the lag grows along the run",
        f"`defaults: {{stamps: {{drift: {middle:.4g}}}}}` sets further files' clock right",
        True,
    )


def _columns_of_first(run: Run) -> Sequence[str]:
    """Columns of a run's first file, whose clock stays; none where it is no table by itself."""
    try:
        return Table(Path(run.files[0]), "run").header
    except ValueError:
        return ()


def _of_further(first: Sequence[str], command: Signal, channel: Signal) -> int:
    """1 where the command is of a further file of the run, -1 where the channel alone is, 0 where
    both are of the first one.

    Args:
        first: Columns of the first file.
    """
    if command.column not in first:
        return 1
    return 0 if channel.column in first else -1


def _drift(y: Samples, u: Samples) -> float | None:
    """Parts per million by which the clock of a command runs faster; None: no drift is seen."""
    step = float(np.median(np.diff(y.times)))
    grid = np.arange(y.times[0], y.times[-1], step)
    every = max(1, len(grid) // 2000)
    grid = grid[::every]
    target = np.interp(grid, y.times, y.values)

    def left(rate: float) -> float:
        at = y.times[0] + (grid - y.times[0]) * (1.0 + rate)
        drive = np.interp(at, u.times, u.values)
        taps = [np.roll(drive, j) for j in range(-EARLY, TAPS)]
        state = [np.roll(target, TAPS + j) for j in (0, 1)]  # what it was before the taps
        inside = slice(TAPS + 1, len(grid) - EARLY)
        matrix = np.column_stack([*taps, *state, np.ones(len(grid))])[inside]
        wanted = target[inside]
        made = matrix @ np.linalg.lstsq(matrix, wanted, rcond=None)[0]
        return float(np.sum((wanted - made) ** 2))

    start = left(0.0)
    sizes = np.concatenate([-np.geomspace(0.1, 1e-4, 22), [0.0], np.geomspace(1e-4, 0.1, 22)])
    rates = [(left(float(r)), float(r)) for r in sizes]
    least, rate = min(rates)
    if least > BETTER * start or rate == 0.0:
        return None
    width = 0.2 * abs(rate)
    for _ in range(12):
        ways = [(left(rate + s * width), rate + s * width) for s in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        rate = min(ways)[1]
        width *= 0.6
    return 1e6 * rate
