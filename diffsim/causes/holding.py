"""Whether a recorded command keeps its value from sample to sample, as far as it shows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from diffsim.data.steps import FEWEST, RESTS, rest_and_jump
from diffsim.data.study import Run


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
    return rest_and_jump(c[name] for c in seen for name in commands if name in c)


def moves_on(runs: Iterable[Run], commands: Sequence[str]) -> bool:
    """Whether some run has a command that changes all the time: it shows no holding.

    Args:
        runs: Runs of a study; those to fit or to select by are looked at.
        commands: Names of the commands.
    """
    seen = [run.command for run in runs if run.use in ("fit", "select")]
    columns = [np.asarray(c[name]) for c in seen for name in commands if name in c]
    return any(len(c) >= FEWEST and np.mean(np.diff(c) != 0.0) > RESTS for c in columns)
