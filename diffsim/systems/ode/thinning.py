"""Long records: fewer rows are simulated where straight lines between these tell the others.

Rows stay at an even interval, so that about as many are left as the study allows. Rows in between
stay, too, wherever a line between their neighbors would be off: at jumps of commands, and where
something that was measured moves too fast. The interval is taken from runs that are not for
testing, and holds for test runs, too.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import median_filter

from diffsim.causes.scales import HELD
from diffsim.core.arrays import Array, IntArray
from diffsim.core.memo import Memo
from diffsim.data.command_jumps import WIDTH
from diffsim.data.signal import moves_on, rest_and_jump, scatter
from diffsim.data.study import Channel, Run, Study
from diffsim.systems.ode.keys import Input
from diffsim.systems.ode.reading import is_held, list_commands_of

Rows = IntArray
INTERVAL = "row_interval"  # place in a study's frame [s]
SAME = 1e-3  # of a command's range: how far lines between rows may be off
SLOW = 1e-2  # of a channel's range
NOISES = 4.0  # noise sd that are no motion
MOST_SHARE = 0.5  # of a run's rows: where more are needed, all stay
LEAST = 3  # rows: each second one and a few more are over that share

_KNOWN: Memo[Run] = Memo()


def interval_of(study: Study, most_rows: int) -> float:
    """Time between two rows by which about as many stay as may [s]; 0: all may.

    A study with a ``frame`` has it from there.

    Args:
        study: Study with all rows; those of test runs are not counted.
        most_rows: Rows of all runs that may be simulated.
    """
    if (kept := study.frame.get(INTERVAL)) is not None:
        return float(kept)
    runs = [run for run in study.runs if run.use != "test" and len(run.time_s) > 1]
    if sum(len(run.time_s) for run in runs) <= most_rows:
        return 0.0
    return sum(float(np.ptp(run.time_s)) for run in runs) / most_rows


def simulated(
    inputs: tuple[Input, ...], study: Study, interval: float
) -> tuple[tuple[Input, ...], Study]:
    """Inputs and study without the rows that lines between others tell; itself where all stay.

    A command that moves while it is held from row to row is on lines then: through the middles of
    its steps where the description says that it is held, through its values where it looks so.

    Args:
        inputs: What drives the system.
        interval: Time between two rows that stay in any case [s]; 0: all stay.
    """
    if not interval > 0.0:
        return inputs, study
    kept = study.frame.get(HELD, {})
    moving = {
        i.name
        for i in inputs
        if (i.held and kept.get(i.name) is False)
        or (is_held(i, study) and moves_on(study.runs, list_commands_of(i, study)))
    }
    stated = [i for i in inputs if i.held and i.name in moving]
    steps = frozenset(name for i in stated for name in list_commands_of(i, study))
    asked = (steps, study.channels, study.commands, interval)
    # the same runs each time: what was found out of them is kept by run
    runs = tuple(
        _KNOWN((run, *asked), partial(_cut, run, study, interval, steps)) for run in study.runs
    )
    before, after = (sum(len(run.time_s) for run in of) for of in (study.runs, runs))
    if after == before:
        return inputs, study
    apart = max(float(np.median(np.diff(run.time_s))) for run in runs if len(run.time_s) > 1)
    said = (
        f"of {before} rows {after} are simulated and compared, those of test runs too: one each "
        f"{apart:.3g} s, and wherever a line between them is off (most_rows)"
    )
    frame = {**study.frame, HELD: {**kept, **dict.fromkeys(moving, False)}}
    used = tuple(i.model_copy(update={"held": False}) if i in stated else i for i in inputs)
    return used, replace(study, runs=runs, frame=frame, mended=(*study.mended, said))


def _through_middles(run: Run, names: Collection[str]) -> Run:
    """A run with lines in place of steps: at a row, the mean of a command before and after it."""
    middles = {
        name: np.append(values[:1], 0.5 * (values[:-1] + values[1:]))
        for name, values in run.command.items()
        if name in names
    }
    return replace(run, command={**run.command, **middles})


def _cut(run: Run, study: Study, interval: float, steps_of: Collection[str]) -> Run:
    """The rows of a run that are needed; all where these are most, or a command is not known."""
    run = _through_middles(run, steps_of)
    count, steps = len(run.time_s), np.diff(run.time_s)
    is_known = all(np.isfinite(values).all() for values in run.command.values())
    if count < WIDTH or not is_known or not (steps > 0.0).all():
        return run
    stride = int(np.ceil(interval / float(np.median(steps)) - 1e-6))
    if stride < 2:
        return run
    stride = max(stride, LEAST)
    rows = np.union1d(np.arange(0, count, stride), [count - 1])
    measured = {c.name for c in study.commands if c.is_measured}
    for name, values in run.command.items():
        noise = _noise(values) if name in measured else 0.0
        limit = max(SAME * float(np.ptp(values)), NOISES * noise)
        limit = 0.0 if rest_and_jump([values]) else limit
        rows = _with_needed(rows, run.time_s, values, limit)
    for channel, values in zip(study.channels, run.measured.T, strict=True):
        rows = np.union1d(rows, _rows_of_motion(channel, run.time_s, values, rows))
    if len(rows) > MOST_SHARE * count:
        return run
    command = {name: _best_lines(run.time_s, v, rows) for name, v in run.command.items()}
    return replace(run.part(rows), command=command, row_s=run.row_s or float(np.median(steps)))


def _rows_of_motion(channel: Channel, times: Array, values: Array, rows: Rows) -> Rows:
    """Rows in between at which a channel moves otherwise than lines do; misread ones are none."""
    seen = np.flatnonzero(np.isfinite(values))
    if len(seen) < WIDTH:
        return rows[:0]
    smooth = median_filter(values[seen], WIDTH, mode="nearest")
    noise = max(_noise(values[seen]), channel.sd or 0.0)
    limit = max(SLOW * float(np.ptp(smooth)), NOISES * noise)
    known = np.union1d(np.searchsorted(seen, rows).clip(max=len(seen) - 1), [0])
    return seen[np.setdiff1d(_with_needed(known, times[seen], smooth, limit), known)]


def _noise(values: Array) -> float:
    return float(scatter(np.diff(values, n=3), 3)) if len(values) > WIDTH else 0.0


def _with_needed(rows: Rows, times: Array, values: Array, limit: float) -> Rows:
    """Rows, and those in between at which lines are off by more than a limit, until none is.

    Args:
        rows: Increasing, the first and the last row among them.
        times: Of all rows, (num_rows,) [s].
        values: At all rows, (num_rows,).
        limit: By how much lines may be off [unit of the values].
    """
    place, kept = np.arange(len(values)), np.zeros(len(values), dtype=bool)
    kept[rows] = True
    while True:
        off = np.abs(values - np.interp(times, times[rows], values[rows]))
        most = np.maximum.reduceat(off, rows)
        part = np.searchsorted(rows, place, side="right") - 1
        needed = np.flatnonzero((off == most[part]) & (off > limit))
        if not len(needed):
            return rows
        kept[needed] = True
        rows = np.flatnonzero(kept)


def _best_lines(times: Array, values: Array, rows: Rows) -> Array:
    """A command at the rows that stay: the lines between them that fit all rows best."""
    place = np.searchsorted(rows, np.arange(len(times)), side="right") - 1
    left = np.minimum(place, len(rows) - 2)
    start, end = times[rows[left]], times[rows[left + 1]]
    share, count = (times - start) / (end - start), len(rows)

    def summed(at_left: Array, at_right: Array) -> Array:
        sums = np.bincount(left, at_left, count) + np.bincount(left + 1, at_right, count)
        return np.asarray(sums, dtype=np.float64)

    beside = np.bincount(left + 1, share * (1.0 - share), count)
    matrix = np.stack([beside, summed((1.0 - share) ** 2, share**2)])  # its upper half
    return np.asarray(solveh_banded(matrix, summed((1.0 - share) * values, share * values)))
