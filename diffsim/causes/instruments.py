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
        acts: Channels by their indices, and what causes do to them, in the order in which they
            act: a map of readings, or how late a clock is, () or (K,) [s].
    """

    acts: tuple[tuple[tuple[int, ...], SignalMap | Tensor], ...] = ()

    @property
    def readings(self) -> tuple[tuple[tuple[int, ...], SignalMap], ...]:
        """Channels and the maps of their readings, in order."""
        return tuple((c, act) for c, act in self.acts if not isinstance(act, Tensor))

    @property
    def clocks(self) -> tuple[tuple[tuple[int, ...], Tensor], ...]:
        """Channels and how late they are [s]."""
        return tuple((c, act) for c, act in self.acts if isinstance(act, Tensor))

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Instruments:
        """A copy in which some channels are f(channels (..., width, num_times), grid)."""
        return replace(self, acts=(*self.acts, (channels, change)))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Instruments:
        """A copy in which some channels show what was ``delay``, () or (K,), ago [s]."""
        return replace(self, acts=(*self.acts, (channels, delay)))

    @property
    def is_empty(self) -> bool:
        """Whether they show all as it is."""
        return not self.acts

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
            signals = change_rows(signals, channels, _make_late(delay), grid)
        return signals.mT

    def read_in_order(self, shown: Tensor, grid: Grid) -> Tensor:
        """The same, what is late at its place among the other changes.

        Args:
            shown: What there is to be read, (..., num_samples, num_channels).
            grid: Times of the samples.
        """
        signals = shown.mT
        for channels, act in self.acts:
            change = _make_late(act) if isinstance(act, Tensor) else act
            signals = change_rows(signals, channels, change, grid)
        return signals.mT


def _make_late(delay: Tensor) -> SignalMap:
    return partial(smoothly_delayed, delay=delay[..., None])


def grid_of(run: Run) -> Grid:
    """Samples of a run and nothing in between."""
    return grid_at(torch.from_numpy(np.asarray(run.time_s, dtype=np.float64)))


def grid_at(times: Tensor) -> Grid:
    """Samples at times [s] and nothing in between."""
    return Grid(times, torch.arange(len(times)), times.numpy())


__all__ = ["Instruments", "grid_at", "grid_of"]
