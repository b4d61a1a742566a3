"""What samples show of their sensor: noise, by their differences, and steps.

Steps are those of readings that were rounded by the sensor, a converter or the file, and of columns
that rest and jump, as what is sent to an actuator does.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from diffsim.core.arrays import Array, IntArray
from diffsim.data.study import Run


def noise_std(x: Array) -> float:
    """Sensor noise from second differences, std / sqrt(6): blind to level and slow motion.

    Args:
        x: (T,) a quiet stretch of one coordinate; gaps are skipped.
    """
    second = np.diff(np.asarray(x, dtype=np.float64), n=2)
    second = second[np.isfinite(second)]
    if len(second) < 10:
        raise ValueError(f"{len(second)} second differences; a noise level needs at least 10")
    return float(np.sqrt(np.mean(second**2) / 6.0))


def scatter(differences: Array, order: int) -> Array:
    """Noise sd behind differences of samples, from their median: blind to spikes and slow motion.

    Args:
        differences: (T, ...) of one order, as of ``numpy.diff``; NaN are passed over.
        order: How often the samples were differenced.

    Returns:
        (...) in the unit of the samples.
    """
    middle = np.nanmedian(np.abs(differences), axis=0)
    return np.asarray(middle / 0.6745 / np.sqrt(float(math.comb(2 * order, order))))


FEWEST_VALUES = 8  # different readings from which on steps are no coincidence
ON_STEP = 0.05  # of a step: how far off it a reading may lie
ROUND = 1e-9  # of the range: readings that close are equal
GAP = 1.5  # usual time steps: a longer one lacks a row
COMMAND_JUMP = 3.0  # usual changes from row to row, beyond which a command jumped
MOST_LOST = 2  # lost rows that a line bridges
EVEN, OFF = 0.1, 0.45  # of a usual step, that a gap is off whole ones: usually, and at most
LATE = 5.0  # sd of the stamps: no row comes later by chance
AROUND = 5  # rows to either side of a gap


def step_of(readings: Array) -> float | None:
    """Step on whole numbers of which all readings lie, from any zero; None where there is none.

    Args:
        readings: Readings of a channel, (num_samples,); NaN where there are none.
    """
    values = np.unique(readings[np.isfinite(readings)])
    if len(values) < FEWEST_VALUES:
        return None
    gaps = np.diff(values)
    step = float(gaps[gaps > ROUND * np.ptp(values)].min(initial=np.inf))
    # a file of few digits has that gap to a percent: too little to count a thousand of them at once
    step = float(np.ptp(values) / np.maximum(np.round(gaps / step).sum(), 1.0))
    places = (values - values[0]) / step
    if not np.isfinite(step) or np.abs(places - np.round(places)).max() > ON_STEP:
        return None
    return step * float(places[-1] / np.round(places[-1]))  # the mean of many gaps


def rounding_sd(readings: Array) -> float:
    """Standard deviation of what rounding does to readings, step / sqrt(12); 0 without steps."""
    step = step_of(readings)
    return 0.0 if step is None else step / float(np.sqrt(12.0))


RESTS = 0.5  # share of steps without a change from which on a column is one that rests
ISOLATED = 0.8  # share of changes that stand alone: jumps, no ramps
MIN_STEP_SAMPLES = 3  # samples


def rest_and_jump(columns: Iterable[ArrayLike]) -> bool:
    """Whether all changes of columns that rest, but a few, stand alone.

    A ramp changes from sample to sample, a jump between two samples that equal their neighbors.
    Columns that change all the time, as a sine does, say nothing.

    Args:
        columns: Samples of each, (num_samples,) without gaps.
    """
    counts = np.array([_changes(np.asarray(c, dtype=np.float64)) for c in columns])
    if not len(counts) or not counts[:, 0].any():
        return False
    changes, alone = counts.sum(0)
    return bool(alone >= ISOLATED * changes)


def looks_held(runs: Iterable[Run], commands: Sequence[str]) -> bool:
    """Whether commands rest and jump: all changes but a few stand alone.

    A ramp changes from sample to sample, a jump between two samples that equal their neighbors.
    Columns that change all the time, as a sine does, say nothing. Test runs have no say: a frozen
    model stays what it is.

    Args:
        runs: Runs of a study; those to fit or to select by are looked at.
    """
    seen = [run.command for run in runs if run.use in ("fit", "select")]
    return rest_and_jump(c[name] for c in seen for name in commands if name in c)


def moves_on(runs: Iterable[Run], commands: Sequence[str]) -> bool:
    """Whether some run has a command that changes all the time: it shows no holding.

    Args:
        runs: Runs of a study; those to fit or to select by are looked at.
    """
    seen = [run.command for run in runs if run.use in ("fit", "select")]
    columns = [np.asarray(c[name]) for c in seen for name in commands if name in c]
    return any(len(c) >= MIN_STEP_SAMPLES and np.mean(np.diff(c) != 0.0) > RESTS for c in columns)


def _changes(column: Array) -> tuple[int, int]:
    """Number of changes of a column that rests, and how many of them stand alone."""
    if len(column) < MIN_STEP_SAMPLES:
        return 0, 0
    changed = np.diff(column) != 0.0
    if 1.0 - changed.mean() < RESTS:
        return 0, 0
    around = np.concatenate([[False], changed, [False]])
    alone = changed & ~around[:-2] & ~around[2:]
    return int(changed.sum()), int(alone.sum())


def lost_rows(time_s: Array) -> IntArray:
    """Rows that a recorder dropped behind each row, (T-1,): of one or two, where they fill the gap
    in usual steps; 0 elsewhere. Of more nobody knows what a command did.

    Args:
        time_s: Stamps of the rows, increasing [s].
    """
    steps = np.diff(time_s)
    if not len(steps):
        return np.zeros(0, dtype=np.int64)
    usual = float(np.median(steps))
    rows = np.round(steps / usual)
    # how stamps scatter tells a row that came late from one that was lost, or that nothing does
    late = LATE * float(scatter(steps - usual, 0))
    off = max(EVEN * usual, min(late, OFF * usual))
    is_lost = (steps > max(GAP * usual, usual + late)) & (rows <= MOST_LOST + 1)
    return np.where(is_lost & (np.abs(steps - rows * usual) < off), rows - 1, 0).astype(np.int64)


def swept_rows(time_s: Array, commands: Sequence[Array]) -> IntArray:
    """Of ``lost_rows`` those over which all commands that moved went on as in the rows around."""
    lost = lost_rows(time_s) if commands else np.zeros(max(len(time_s) - 1, 0), dtype=np.int64)
    moves = np.zeros(len(lost), dtype=bool)
    for k in np.flatnonzero(lost).tolist():
        first = max(k - AROUND, 0)
        near = [np.abs(np.diff(u[first : k + 2 + AROUND])) for u in commands]
        moved = np.array([around[k - first] for around in near])
        usual = np.array([np.median(np.delete(around, k - first)) for around in near])
        most = COMMAND_JUMP * usual * (lost[k] + 1)
        moves[k] = bool(moved.any() and (moved <= most).all())
    return np.where(moves, lost, 0)
