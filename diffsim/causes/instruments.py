"""What shows the channels of a run: readings and clocks that causes may change."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import delays_of
from diffsim.causes.signals import Grid, SignalMap, change_rows, smoothly_delayed
from diffsim.data.study import Run


@dataclass(frozen=True, eq=False)
class Instruments:
    """What instruments make of channels.

    Attributes:
        readings: What causes do to channels, by their indices, in the order in which they act.
        clocks: How late channels are [s].
    """

    readings: tuple[tuple[tuple[int, ...], SignalMap], ...] = ()
    clocks: tuple[tuple[tuple[int, ...], Tensor], ...] = ()

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Instruments:
        """A copy in which some channels are f(channels (..., width, num_times), grid)."""
        return replace(self, readings=(*self.readings, (channels, change)))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Instruments:
        """A copy in which some channels show what was ``delay``, () or (K,), ago [s]."""
        return replace(self, clocks=(*self.clocks, (channels, delay)))

    @property
    def is_empty(self) -> bool:
        """Whether they show all as it is."""
        return not (self.readings or self.clocks)

    def num_points(self, num_channels: int) -> int:
        """Number of points K of what causes do; 0 where sizes have no axis of points.

        Args:
            num_channels: Number of channels that are read.
        """
        leads = [delay.shape for _, delay in self.clocks]
        for channels, change in self.readings:
            try_out = torch.zeros(len(channels) or num_channels, 2, dtype=torch.float64)
            leads.append(change(try_out, Grid.even(2, 1.0)).shape[:-2])
        return max((lead[0] for lead in leads if lead), default=0)

    def read(self, shown: Tensor, grid: Grid) -> Tensor:
        """What the instruments say, their clocks apart.

        Args:
            shown: What there is to be read, (..., num_samples, num_channels).
            grid: Times of the samples.
        """
        signals = shown.mT
        for channels, change in self.readings:
            signals = change_rows(signals, channels, change, grid)
        return signals.mT

    def read_late(self, shown: Tensor, grid: Grid) -> Tensor:
        """The same by clocks that are late, smooth between samples."""
        signals = self.read(shown, grid).mT
        for channels, delay in delays_of(self.clocks).items():
            late = partial(smoothly_delayed, delay=delay[..., None])
            signals = change_rows(signals, channels, late, grid)
        return signals.mT


def grid_of(run: Run) -> Grid:
    """Samples of a run and nothing in between."""
    return grid_at(torch.from_numpy(np.asarray(run.time_s, dtype=np.float64)))


def grid_at(times: Tensor) -> Grid:
    """Samples at times [s] and nothing in between."""
    return Grid(times, torch.arange(len(times)), times.numpy())


__all__ = ["Instruments", "grid_at", "grid_of"]
