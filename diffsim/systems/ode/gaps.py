"""Rows that a recorder dropped while a command was held: it changed somewhere inside the gap.

When it jumped is not recorded, so it is a nuisance of the run with the gap as its bounds, and no
cause. A command that moves from row to row went on to do so: steps on a line between its neighbors.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.signals import Grid
from diffsim.data.signal import COMMAND_JUMP, GAP, lost_rows
from diffsim.data.study import Run
from diffsim.identify.model import Parameter


@dataclass(frozen=True)
class Gap:
    """A gap in the rows across which a held command changed."""

    name: str  # base parameter that says when: the share of the gap that was over
    # start, end: times of the rows beside it [s]
    start: float
    end: float
    swept: int = 0  # rows that are lost of a command that moves from row to row; 0: it jumped

    @property
    def parameter(self) -> Parameter:
        """The nuisance: anything from the start to the end of the gap."""
        # anything from 0 to 1 alike
        return Parameter(self.name, 0.5, 1.0 / np.sqrt(12.0), lower=0.0, upper=1.0)

    def change(self, column: Tensor, grid: Grid, values: Mapping[str, Tensor]) -> Tensor:
        """A held command that changes inside the gap; steps that it cuts have the mean.

        Args:
            column: The command at the times of the integrator, (..., num_times); until the end of
                the gap as before it.
            grid: Times of the integrator.
            values: Base parameters by name: that of a jump, () or (K,).
        """
        times = grid.times
        first, last = (int(torch.searchsorted(times, t)) for t in (self.start, self.end))
        if last >= len(times):  # the first part of a run
            return column
        inside = times[first : last + 1]
        whole = torch.arange(1.0, self.swept + 1.0, dtype=inside.dtype) / (self.swept + 1.0)
        shares = whole.unbind() if self.swept else (values[self.name],)
        over = torch.zeros(())
        for share in shares:
            at = self.start + share[..., None] * (self.end - self.start)
            over = over + ((inside[1:] - at) / inside.diff()).clamp(0.0, 1.0)
        over = over / (self.swept + 1.0)
        rise = column[..., last : last + 1] - column[..., first : first + 1]
        more = torch.nn.functional.pad(rise * over, (first, len(times) - last))
        return column + more


def find_gaps(run: Run, commands: Iterable[str]) -> tuple[Gap, ...]:
    """Gaps of a run across which one of these commands changed.

    Args:
        commands: Names of commands that are held from row to row.
    """
    steps = np.diff(run.time_s)
    columns = [np.asarray(run.command[c], dtype=np.float64) for c in commands if c in run.command]
    if not len(steps) or not columns:
        return ()
    usual = float(np.median(steps))
    changes = np.abs(np.diff(np.stack(columns), axis=1))
    jumps = np.any(changes > COMMAND_JUMP * np.median(changes, axis=1, keepdims=True), axis=0)
    lost = lost_rows(run.time_s)
    is_swept = (lost > 0) & np.any(changes > 0.0, axis=0)
    found = np.flatnonzero((jumps | is_swept) & (steps > GAP * usual))
    return tuple(
        Gap(
            f"change_in_gap_at_{1e3 * run.time_s[k]:.6g}_ms@{run.name}",
            float(run.time_s[k]),
            float(run.time_s[k + 1]),
            0 if jumps[k] else int(lost[k]),
        )
        for k in found
    )
