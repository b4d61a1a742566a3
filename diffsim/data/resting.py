"""Whether columns rest and jump, as what is sent to an actuator does."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

RESTS = 0.5  # share of steps without a change from which on a column is one that rests
ISOLATED = 0.8  # share of changes that stand alone: jumps, no ramps
FEWEST = 3  # samples


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
