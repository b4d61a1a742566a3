"""Jumps of measured commands: the sensor's, or what acted? The model tells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.data.command_jumps import jumps_of, without_jumps
from diffsim.data.study import Command, Run


def without_misread(run: Run, commands: Sequence[Command]) -> tuple[Run, int]:
    """A run without the jumps of its measured commands.

    What is commanded may jump, so that other commands stay.

    Args:
        run: Run as it was recorded.

    Returns:
        The run, the same object where nothing jumps, and the number of jumps.
    """
    mended, count = dict(run.command), 0
    for name in (c.name for c in commands if c.is_measured and c.name in run.command):
        values = run.command[name]
        jumps = jumps_of(values, is_measured=True, times=run.time_s)
        if num := len(jumps.back) + len(jumps.lasting):
            mended[name] = without_jumps(values, run.time_s, jumps)
            count += num
    return (replace(run, command=mended), count) if count else (run, 0)


def choose_commands(
    run: Run, commands: Sequence[Command], left: Callable[[Run], Array], sd: Array
) -> tuple[Run, int]:
    """A run with its measured commands as recorded, or without jumps: as the model is nearer.

    Without them where both are as near, such as for a model that does not use the command: a
    motion cannot jump, and what a record shows of a jump is seen in the channels.

    Args:
        left: Measured minus predicted in a run, (num_samples, num_channels) [unit of the channel].
        sd: Standard deviation of the noise, (num_channels,) [unit of the channel].

    Returns:
        The run, and the number of jumps that were taken out.
    """
    mended, count = without_misread(run, commands)
    if not count:
        return run, 0
    as_recorded, without = (float(np.nansum((left(r) / sd) ** 2)) for r in (run, mended))
    return (run, 0) if as_recorded < without else (mended, count)
