"""Runs that could be recorded next, made from what a study's commands can do.

Each is called so that a person can record it: "force: chirp 0.5 to 5 Hz, 2 N, 8 s". Levels lie
within the limits that the study states for a command, else within what was seen; no command moves
faster than its ``rate``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.files import csv_text
from diffsim.core.units import factor
from diffsim.data.study import Command, Run, Study

MAX_RUNS = 24
MAX_SAMPLES = 600  # of a run: the clock of the longest recorded one is thinned or cut to it
NEXT = "next"  # use of a run that nobody has recorded
_STAIRS = 6
_PER_PERIOD = 8  # samples in the fastest period of a chirp
_CYCLES = 3.0  # of the slowest frequency of a chirp in a run
_SHOWN = 0.005  # of the size of a chirp, below which its middle is zero
_FLOWN = ("multicopter", "copter")


@dataclass(frozen=True)
class _Drive:
    """What one command can do."""

    name: str
    low: float  # least value [unit]
    high: float  # largest value [unit]
    rest: float  # value before anything happens [unit]
    rate: float  # fastest change [unit/s]
    unit: str  # unit in which people read it
    scale: float  # number of that unit in one of the command's

    def level(self, value: float) -> str:
        """A value in words, such as "2 N"."""
        return f"{value * self.scale:.4g} {self.unit}".strip()


def generated_bank(study: Study) -> tuple[Run, ...]:
    """Runs that could be recorded next; ``measured`` is zero, it only gives the shape.

    Steps, stairs, ramps and chirps of one command at a time; recorded commands with other
    amplitude and speed, under other values of the facts that ``allows`` names or that differ
    between runs, and once more as they were. Of what flies, or has no command that can be set,
    the last two only.

    Args:
        study: Study with at least one fit run.
    """
    if not study.fit_runs:
        return ()
    like = max(study.fit_runs, key=lambda run: run.time_s[-1] - run.time_s[0])
    like = _thin_run(like)
    drives = [drive for name in like.command if (drive := _find_drive(study, name)) is not None]
    if study.system in _FLOWN:  # what is commanded there follows from the motion
        drives = []
    made = [
        *(run for drive in drives for run in (_signals if _lasts(like) else _poses)(like, drive)),
        *_other_sizes(study, drives),
        *_other_facts(study),
        *_repeat_runs(study),
    ]
    first: dict[str, Run] = {}
    for run in made:
        first.setdefault(run.name, run)
    return tuple(_spread(list(first.values()), MAX_RUNS))


def _spread(runs: list[Run], most: int) -> list[Run]:
    """At most so many, from all over the list."""
    if len(runs) <= most:
        return runs
    return [runs[i] for i in np.linspace(0, len(runs) - 1, most).round().astype(int)]


def _thin_run(run: Run) -> Run:
    """A run of at most ``MAX_SAMPLES`` samples, from its beginning, evenly sampled."""
    n = min(len(run.time_s), MAX_SAMPLES)
    step = float(np.median(np.diff(run.time_s))) if len(run.time_s) > 1 else 1.0
    time_s = run.time_s[0] + step * np.arange(n)
    command, columns = (
        {name: np.full(n, _find_rest(values)) for name, values in recorded.items()}
        for recorded in (run.command, run.columns)
    )
    blank = np.zeros((n, run.measured.shape[1]))
    made = {"time_s": time_s, "measured": blank, "command": command, "columns": columns}
    return replace(run, **made, raw={}, use=NEXT)


def _find_rest(values: Array) -> float:
    there = values[np.isfinite(values)]
    return float(there[0]) if len(there) else 0.0


def _find_drive(study: Study, name: str) -> _Drive | None:
    """What a command can do; None where it cannot be commanded or never changed."""
    known = next((c for c in study.commands if c.name == name), Command(name))
    if known.is_measured:
        return None
    values = np.concatenate([run.command[name] for run in study.runs if name in run.command])
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low = float(values.min()) if known.lower is None else known.lower
    high = float(values.max()) if known.upper is None else known.upper
    if not high > low:
        return None
    rest = float(np.clip(_find_rest(study.fit_runs[0].command[name]), low, high))
    rate = float("inf") if known.rate is None else known.rate
    shown = known.shown_unit or known.unit or ""
    scale = factor(known.unit, shown) if known.unit and shown else 1.0
    return _Drive(name, low, high, rest, rate, "" if shown == "-" else shown, scale)


def _lasts(run: Run) -> bool:
    """Whether a run is more than one sample, a pose."""
    return bool(run.time_s[-1] > run.time_s[0])


def _poses(like: Run, drive: _Drive) -> Iterator[Run]:
    """One command at levels over its range; all others rest."""
    for share in np.linspace(0.0, 1.0, _STAIRS):
        level = drive.low + float(share) * (drive.high - drive.low)
        values = np.full(len(like.time_s), level)
        yield _drive_command(like, drive, f"held at {drive.level(level)}", values)


def _signals(like: Run, drive: _Drive) -> Iterator[Run]:
    """Steps, stairs, a ramp and chirps of one command; all others rest."""
    t = like.time_s - like.time_s[0]
    total = float(t[-1])
    far = drive.high if drive.high - drive.rest >= drive.rest - drive.low else drive.low
    for share in (1.0, 0.25):
        level = drive.rest + share * (far - drive.rest)
        values = np.where(t >= 0.1 * total, level, drive.rest)
        yield _drive_command(like, drive, f"step to {drive.level(level)}", values)
    other = drive.low if far == drive.high else drive.high
    if other != drive.rest:
        values = np.where(t >= 0.1 * total, other, drive.rest)
        yield _drive_command(like, drive, f"step to {drive.level(other)}", values)
    stairs = drive.rest + (far - drive.rest) * np.minimum(
        np.floor(t / total * 2 * _STAIRS), 2 * _STAIRS - 1 - np.floor(t / total * 2 * _STAIRS)
    ).clip(0, _STAIRS) / (_STAIRS - 1)
    yield _drive_command(like, drive, f"stairs up to {drive.level(far)} and down", stairs)
    ramp = drive.rest + (far - drive.rest) * (1.0 - np.abs(2.0 * t / total - 1.0))
    yield _drive_command(like, drive, f"ramp up to {drive.level(far)} and down", ramp)
    for share in (1.0, 0.2):
        yield from _chirp(like, drive, share)


def _chirp(like: Run, drive: _Drive, share: float) -> Iterator[Run]:
    """A sine that grows faster, as fast as the clock shows and the command can move."""
    t = like.time_s - like.time_s[0]
    total = float(t[-1])
    size = 0.5 * share * (drive.high - drive.low)
    middle = float(np.clip(drive.rest, drive.low + size, drive.high - size))
    step = float(np.median(np.diff(t)))
    slow = _CYCLES / total
    fast = min(1.0 / (_PER_PERIOD * step), drive.rate / (2.0 * np.pi * size))
    if not fast > 1.5 * slow:
        return
    growth = np.log(fast / slow)
    phase = 2.0 * np.pi * slow * total / growth * (np.exp(growth * t / total) - 1.0)
    what = f"chirp {slow:.2g} to {fast:.2g} Hz, {drive.level(size)}"
    about = f" about {drive.level(middle)}" if abs(middle) > _SHOWN * size else ""
    yield _drive_command(like, drive, f"{what}{about}", middle + size * np.sin(phase))


def _drive_command(like: Run, drive: _Drive, what: str, values: Array) -> Run:
    """A run in which one command does something, no faster than it can."""
    total = like.time_s[-1] - like.time_s[0]
    name = f"{drive.name}: {what}, {total:.3g} s"
    limited = _limit_to_drive(values, like.time_s, drive)
    return replace(
        like, name=name, group=name, use=NEXT, command={**like.command, drive.name: limited}
    )


def _limit_to_drive(values: Array, time_s: Array, drive: _Drive) -> Array:
    """Values within the limits of a command and its rate."""
    out = np.clip(values, drive.low, drive.high)
    if np.isfinite(drive.rate):
        most = drive.rate * np.diff(time_s)
        for i, step in enumerate(most):
            out[i + 1] = np.clip(out[i + 1], out[i] - step, out[i] + step)
    return np.asarray(out)


def _other_sizes(study: Study, drives: list[_Drive]) -> Iterator[Run]:
    """Recorded commands with another amplitude, slower and faster."""
    if not drives:
        return
    for run in _one_of_each_command(study):
        for size in (0.5, 1.5):
            yield from _change_commands(
                run, drives, f"{run.name} again, {size:g} times as large", size, 1
            )
        for speed in (0.5, 2.0) if _lasts(run) else ():
            words = "twice as fast" if speed == 2.0 else "half as fast"
            yield from _change_commands(run, drives, f"{run.name} again, {words}", 1.0, speed)


def _change_commands(
    run: Run, drives: list[_Drive], name: str, size: float, speed: float
) -> Iterator[Run]:
    """A recorded run with its commands changed, if they stay within their limits."""
    t = run.time_s - run.time_s[0]
    command = dict(run.command)
    for drive in drives:
        values = run.command[drive.name]
        wanted = drive.rest + size * (values - drive.rest)
        there = np.isfinite(wanted)
        if not there.any():
            return
        wanted = np.interp(speed * t, t[there], wanted[there])
        limited = _limit_to_drive(wanted, run.time_s, drive)
        if np.abs(limited - wanted).max() > 0.05 * (drive.high - drive.low):
            return
        command[drive.name] = limited
    if all(np.array_equal(command[d.name], run.command[d.name]) for d in drives):
        return
    yield replace(
        run, name=name, group=name, use=NEXT, command=command, measured=np.zeros_like(run.measured)
    )


def _one_of_each_command(study: Study) -> list[Run]:
    """The first samples of runs, measured ones kept: some models start from them."""
    runs = {run.group: run.part(slice(MAX_SAMPLES)) for run in study.fit_runs}
    return _spread(list(runs.values()), 3)


def _other_facts(study: Study) -> Iterator[Run]:
    """Recorded commands under other facts: those of other runs, and those that are allowed."""
    words = set(_collect_words(study.model))
    seen = {_facts(run.setup, words): run for run in study.runs}
    bundles = [dict(facts) for facts in seen]
    if len(bundles) > max(4, len(study.runs) // 3):  # facts of single runs, such as start speeds
        bundles = []
    recorded = {(run.group, _facts(run.setup, words)) for run in study.runs}
    for run in _one_of_each_command(study):
        changes = [{k: v for k, v in b.items() if run.setup.get(k) != v} for b in bundles]
        changes += [{key: value} for key, values in study.allows.items() for value in values]
        for change in changes:
            setup = {**run.setup, **change}
            if not change or (run.group, _facts(setup, words | set(change))) in recorded:
                continue
            told = ", ".join(f"{k} = {_format_value(v)}" for k, v in change.items())
            name = f"{run.name} again, with {told}"
            yield replace(run, name=name, group=name, use=NEXT, setup=setup)


def _format_value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _collect_words(stated: Any) -> Iterator[str]:
    """Words of a description: facts that it does not mention change nothing."""
    if isinstance(stated, Mapping):
        for key, value in stated.items():
            yield from (*_collect_words(key), *_collect_words(value))
    elif isinstance(stated, (list, tuple)):
        for value in stated:
            yield from _collect_words(value)
    elif isinstance(stated, str):
        yield from re.findall(r"\w+", stated)


def _repeat_runs(study: Study) -> Iterator[Run]:
    """Recorded runs once more, as they were: what a repeat is worth."""
    for run in _one_of_each_command(study):
        yield replace(run, name=f"{run.name} again", group=run.group, use=NEXT)


def _facts(setup: Mapping[str, Any], words: set[str]) -> tuple[tuple[str, Any], ...]:
    return tuple(sorted((k, v) for k, v in setup.items() if k in words))


def command_table(run: Run, study: Study) -> str:
    """Commands of a run as CSV, in the units in which the user reads them."""
    known = {c.name: c for c in study.commands}
    header, columns = ["time_s"], [run.time_s - run.time_s[0]]
    for name, values in run.command.items():
        command = known.get(name, Command(name))
        shown = command.shown_unit or command.unit
        scale = factor(command.unit, shown) if command.unit and shown else 1.0
        header.append(f"{name} ({shown})" if shown else name)
        columns.append(values * scale)
    return csv_text(header, zip(*columns, strict=True), ".9g")
