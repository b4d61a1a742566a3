"""Whether a recorded command keeps its value from sample to sample, as far as it shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Run

RESTS = 0.5  # share of steps without a change from which on a column is one that rests
ISOLATED = 0.8  # share of changes that stand alone: jumps, no ramps
FEWEST = 3  # samples


def looks_held(runs: Iterable[Run], commands: Sequence[str]) -> bool:
    """Whether commands rest and jump: all changes but a few stand alone.

    A ramp changes from sample to sample, a jump between two samples that equal their neighbors.
    Columns that change all the time, as a sine does, say nothing. Test runs have no say: a frozen
    model stays what it is.

    Args:
        runs: Runs of a study; those to fit or to select by are looked at.
        commands: Names of the commands.
    """
    seen = [run.command for run in runs if run.use in ("fit", "select")]
    columns = [command[name] for command in seen for name in commands if name in command]
    counts = np.array([_changes(np.asarray(c, dtype=np.float64)) for c in columns])
    if not len(counts) or not counts[:, 0].any():
        return False
    changes, alone = counts.sum(0)
    return bool(alone >= ISOLATED * changes)


def moves_on(runs: Iterable[Run], commands: Sequence[str]) -> bool:
    """Whether some run has a command that changes all the time: it shows no holding.

    Args:
        runs: Runs of a study; those to fit or to select by are looked at.
        commands: Names of the commands.
    """
    seen = [run.command for run in runs if run.use in ("fit", "select")]
    columns = [np.asarray(c[name]) for c in seen for name in commands if name in c]
    return any(len(c) >= FEWEST and np.mean(np.diff(c) != 0.0) > RESTS for c in columns)


def _changes(column: NDArray[np.float64]) -> tuple[int, int]:
    """Number of changes of a column that rests, and how many of them stand alone."""
    if len(column) < FEWEST:
        return 0, 0
    changed = np.diff(column) != 0.0
    if 1.0 - changed.mean() < RESTS:
        return 0, 0
    around = np.concatenate([[False], changed, [False]])
    alone = changed & ~around[:-2] & ~around[2:]
    return int(changed.sum()), int(alone.sum())
