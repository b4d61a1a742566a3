"""A first study of an unknown folder: which columns and files look like what, and why."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.units import to_si
from diffsim.data.clock_guess import (
    guess_clock,
    guess_split,
    is_counter,
    is_late,
)
from diffsim.data.folder_tables import FolderRecording, recordings_in
from diffsim.data.runs_guess import (
    GuessedQuantity,
    GuessedRun,
    facts_of_name,
    find_repeats,
    give_uses,
    say,
)
from diffsim.data.signal import scatter
from diffsim.data.table_guess import Column, TableLayout

Array = NDArray[np.float64]
_COMMAND = re.compile(
    r"(^|_)(cmd|command|commanded|set|setpoint|goal|desired|des|ref|reference|target|input|pwm|duty|"
    r"throttle|esc|signal|demand|actions?|control|controller|drive|pump|valve|contraction|soll|"
    r"sollwert|consigne|voltage)(_|\d|$)"
    r"|^u\d*$|^(m|mot|motor|rotor|rpm|servo|rc|out)_?\d+$",
    re.I,
)
#: Sensors by their names, and motion by names that mean it with a unit of motion.
_SENSOR = re.compile(
    r"(^|_)(obs|observations?|gyro|acc|accel|accelerometer|imu|mocap|vicon|optitrack|encoder|odom|gps|baro|"
    r"measured|meas|ist|istwert|bat|battery|emf|temp|temperature)(_|\d|$)",
    re.I,
)
_MOTION = re.compile(
    r"^(p|q|r|[xyz]|[vapgw][xyz]|d?(phi|theta|psi))(_?\d)?(_(pos|ned|enu|world|body|b|w))?$"
    r"|(^|_)(pos|position|vel|velocity|acc|acceleration|height|altitude|displacement|"
    r"(ang(ular|le)?_?)(rate|vel|velocity|speed|acc)?|(body_?)?rates?|omega|"
    r"(roll|pitch|yaw|nick|gier|heading|tilt)(_?rate|_?speed)?)(_?[xyzpqr\d])?(_|$)",
    re.I,
)
_MOTION_UNITS = ("m", "rad", "m/s", "rad/s", "m/s^2", "rad/s^2")
_QUATERNION = re.compile(r"(^|_)(q|quat|quaternion)_?[wxyz0-3]$", re.I)  # has no unit
_STAMP = re.compile(r"(^|_)(time)?stamp(_|$)", re.I)  # further clocks of a log
_FLAG = re.compile(r"(^|_)(repeated|valid|invalid|flag|status|missing|ok|error)(_|\d|$)", re.I)
_MEASURED = re.compile(r"control|controller|pwm|duty|feedback", re.I)
_BY_TOPIC = "by its topic"
_SET_UNITS = ("N", "Nm", "Pa", "V", "A", "Hz")  # what drives, rather than what moves
_SMOOTH = 1e-5  # standard deviation over the range: a sensor scatters by more
_HELD = 0.5  # share of samples that repeat the one before, from which on a column looks commanded
MIN_EQUAL = 10  # samples: fewer may be equal by chance
_LARGE = 0.05  # of the range: changes of what is held and looks commanded
MAX_SIZE = 100_000  # samples of all channels and runs, from which on only each n-th is used


@dataclass
class Guess:
    """What a folder seems to hold.

    Attributes:
        layout: Lay-out of the files that are used.
        time: Keys of ``time``, of each file of a run where these have clocks of other names.
        is_late: Whether the clock counts from long ago, so that runs should start at 0 s.
        channels: Columns that look measured.
        commands: Columns that look commanded.
        facts: Columns that are constant in every run.
        runs: Runs, one for each file or value of ``split``.
        split: Columns whose values are runs; empty: each file is one.
        every: Each n-th sample is enough.
        said: What was guessed, a sentence each.
        todo: What the user must say, a sentence each.
    """

    layout: TableLayout
    time: dict[str, Any] | list[dict[str, Any]]
    is_late: bool
    channels: list[GuessedQuantity]
    commands: list[GuessedQuantity]
    facts: list[Column]
    runs: list[GuessedRun]
    split: tuple[Column, ...]
    every: int
    said: list[str]
    todo: list[str]


def guess_study(folder: Path, parts: Sequence[str] = ()) -> Guess:
    """Look at the tables of a folder; nothing is asked, everything guessed is said.

    Args:
        folder: Folder with the user's files.
        parts: Tables of each file that are used, the record first; empty: as they look.

    Raises:
        ValueError: no table that looks like a recording.
    """
    said: list[str] = []
    todo: list[str] = []
    layout, recordings, times = recordings_in(folder, said, parts)
    tables = [one.table for one in recordings]
    time, clock, clock_todo = guess_clock(layout, tables, said)
    todo += clock_todo
    split = guess_split(layout, tables, clock, said)
    runs = _runs(recordings, split, said)
    numbers = {c.name: all(t.is_number[c.name] for t in tables) for c in layout.columns if c.name}
    free = [c for c in layout.columns if c.name and c is not clock]
    numeric = [c for c in free if numbers[c.name] and c not in split]
    labels = [c for c in free if c not in split or not numbers[c.name]]
    facts = [c for c in labels if _is_fact(c, runs)]
    idle = [
        c
        for c in numeric
        if is_counter(c, runs[0].table, runs[0].rows)
        or _FLAG.search(c.base)
        or _STAMP.search(c.base)
    ]
    said_nothing = [c.name for c in free if not numbers[c.name] and c not in (*facts, *split)]
    say(said, "texts and empty columns, not used", said_nothing)
    moving = [c for c in numeric if c not in facts and c not in idle]
    say(said, "counters and flags, not used (see missing_if)", [c.name for c in idle])
    say(said, "facts, constant in each run", [c.name for c in facts])
    commands, channels = _sorted_out(moving, runs, said, todo)
    for run in runs:
        run.setup = facts_of_name(run.file)
    find_repeats(runs, commands, facts, said)
    give_uses(runs, said)
    size = sum(len(run.rows) for run in runs) * max(len(channels), 1)
    every = max(1, round(size / MAX_SIZE))
    if every > 1:
        said.append(
            f"{size} samples cost time: one of {every} is used; a window or fewer runs do better"
        )
    late = is_late(time, clock, tables)
    if late:
        said.append("zero_time: the clock counts from long ago; every run starts at 0 s")
    clocks = times if any(t != time for t in times) else time
    return Guess(layout, clocks, late, channels, commands, facts, runs, split, every, said, todo)


def _runs(
    recordings: Sequence[FolderRecording], split: tuple[Column, ...], said: list[str]
) -> list[GuessedRun]:
    runs = []
    for one in recordings:
        table, rows = one.table, np.arange(len(one.table))
        if not split:
            runs.append(GuessedRun(one.name, one.file, table, rows, further=one.further))
            continue
        cells = np.array(
            [" ".join(row) for row in zip(*map(table.texts, _names(split)), strict=True)]
        )
        for value in dict.fromkeys(cells.tolist()):
            name = f"{one.name}_{value}" if len(split) == 1 else value
            own = rows[cells == value]
            runs.append(GuessedRun(name, one.file, table, own, value, further=one.further))
    if not split:
        said.append(f"runs: one for each of {len(runs)} files" if len(runs) > 1 else "runs: one")
    return runs


def _names(columns: Sequence[Column]) -> list[str]:
    return [c.name for c in columns]


def _is_fact(column: Column, runs: Sequence[GuessedRun]) -> bool:
    """Whether a column is constant in every run, and says something."""
    for run in runs:
        cells = run.table.texts(column.name)
        if len({cells[i] for i in run.rows}) != 1 or not cells[run.rows[0]]:
            return False
    return True


def _sorted_out(
    columns: Sequence[Column], runs: Sequence[GuessedRun], said: list[str], todo: list[str]
) -> tuple[list[GuessedQuantity], list[GuessedQuantity]]:
    """Commands and channels; what is held for many samples, or called so, looks commanded."""
    commands: list[GuessedQuantity] = []
    channels: list[GuessedQuantity] = []
    unstated: list[str] = []
    samples = {c.name: [r.table.numbers(c.name)[r.rows] for r in runs] for c in columns}
    equal = _equal_in_two(samples)
    for column in columns:
        values = samples[column.name]
        why = _explain_commanded(column, values) or equal.get(column.name, "")
        why = "" if _is_sensed(column) and why != _BY_TOPIC else why
        name = column.name if _keeps_name(column) else column.base
        taken = {q.name for q in (*commands, *channels)}
        name = name if name not in taken else f"{name}_{len(taken)}"
        if column.unit is None and not _QUATERNION.match(column.base):
            unstated.append(column.name)
        unit = column.unit or "-"
        if why:
            found = [v[np.isfinite(v)] for v in values]
            lower = min((float(v.min()) for v in found if len(v)), default=None)
            upper = max((float(v.max()) for v in found if len(v)), default=None)
            is_measured = bool(_MEASURED.search(column.base)) and "held" not in why
            commands.append(
                GuessedQuantity(name, column, unit, why, None, lower, upper, is_measured)
            )
        else:
            channels.append(GuessedQuantity(name, column, unit, "", _noise(values)))
    say(todo, "units, which the header does not state", unstated, most=40)
    if not channels and commands:
        last = commands.pop()
        channels.append(GuessedQuantity(last.name, last.column, last.unit, "", None))
    said += [f"command: {q.name}, {q.why}" for q in commands]
    say(said, "channels: what is left", [q.name for q in channels])
    if len({q.is_measured for q in commands}) == 2:
        todo.append(
            "commands: some look asked for, some given out by a controller (is_measured); keep "
            "those that drive your model"
        )
    if not commands:
        todo.append("commands: no column looks commanded; which of the channels did you set?")
    if channels:
        todo.append("sd of each channel: the noise is a guess from the scatter between samples")
    return commands, channels


def _equal_in_two(samples: Mapping[str, Sequence[Array]]) -> dict[str, str]:
    """Columns that two runs share to the last digit, which no sensor does; not copies of runs."""
    count = len(next(iter(samples.values()), ()))
    for i in range(count):
        for k in range(i):
            alike = [name for name, values in samples.items() if _is_equal(values[i], values[k])]
            if alike and len(alike) < len(samples):
                return {name: "equal to the digit in two runs" for name in alike}
    return {}


def _is_equal(a: Array, b: Array) -> bool:
    n = min(len(a), len(b))
    moves = n >= MIN_EQUAL and bool(np.nanmax(a[:n]) > np.nanmin(a[:n]))
    return moves and np.array_equal(a[:n], b[:n], equal_nan=True)


def _keeps_name(column: Column) -> bool:
    """Whether the header itself is a name for formulas, with an SI unit at its end or none."""
    if column.is_said or not re.fullmatch(r"[A-Za-z_]\w*", column.name, re.ASCII):
        return False
    return column.unit is None or to_si(column.unit)[1:] == (1.0, 0.0)


def _explain_commanded(column: Column, values: Sequence[Array]) -> str:
    """Why a column looks commanded; empty: it does not."""
    if column.is_asked:
        return _BY_TOPIC
    if _COMMAND.search(column.base):
        return "by its name"
    repeats = [np.diff(v) == 0.0 for v in values if len(v) > 1]
    held = float(np.mean(np.concatenate(repeats))) if repeats else 0.0
    steps = np.concatenate([np.abs(np.diff(v[np.isfinite(v)])) for v in values])
    there = np.concatenate([v[np.isfinite(v)] for v in values])
    if not (steps > 0.0).any():
        return ""
    # a slow or coarse sensor is held, too, but changes by little
    if held > _HELD and float(np.median(steps[steps > 0.0])) > _LARGE * float(np.ptp(there)):
        return "held for many samples"
    unit = "" if column.unit is None else re.sub(r"[\s*·.]", "", to_si(column.unit).unit)
    if unit in _SET_UNITS:
        # fourth differences: what is left of a sweep in frequency is rounding
        fourth = np.concatenate([np.diff(v[np.isfinite(v)], n=4) for v in values])
        if len(fourth) and float(scatter(fourth, 4)) < _SMOOTH * float(np.ptp(there)):
            return "by its lack of noise"
    return ""


def _is_sensed(column: Column) -> bool:
    """Whether the name says that a column was measured, however still it is at times."""
    if _SENSOR.search(column.base):
        return True
    if _COMMAND.search(column.base) or not _MOTION.search(column.base):
        return False
    return column.unit is not None and to_si(column.unit).unit in _MOTION_UNITS


def _noise(values: Sequence[Array]) -> float | None:
    """Scatter from sample to sample, with two digits; at least that of rounding."""
    levels = []
    for v in values:
        second = np.diff(v[np.isfinite(v)], n=2)  # a slow sensor leaves cells empty
        if len(second) >= 8:
            levels.append(float(scatter(second, 2)))
    there = np.unique(np.concatenate([v[np.isfinite(v)] for v in values]))
    step = float(np.min(np.diff(there))) if 1 < len(there) < 2000 else 0.0
    level = max(float(np.median(levels)) if levels else 0.0, step / np.sqrt(12.0))
    return float(f"{level:.2g}") if level > 0.0 else None
