"""Instruments of a scene that says at each sample what there is to be read."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.catalogue import rows
from diffsim.causes.channel_groups import ChannelGroup, channel_groups, delays_of
from diffsim.causes.ports import SignalMap
from diffsim.causes.readings import SENSOR, Instrument, reading_cause
from diffsim.causes.row import ANY, spell_plainly
from diffsim.causes.scales import Scales
from diffsim.causes.signals import Grid, change_rows, smoothly_delayed
from diffsim.data.study import Channel, Run
from diffsim.identify.effect import Effect

if TYPE_CHECKING:
    from typing_extensions import Self

#: Rows in whose maps time counts: samples without an order have none of them.
TIMED_READINGS = ("sensor_lag", "sensor_drift", "sensor_backlash", "sensor_delay")
TIMED_COMMANDS = ("lag", "delay", "backlash", "rate_limit")
_NAMED = ("sensor_offset", "sensor_drift")  # after the kind, even where there is no other


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


@dataclass(frozen=True, kw_only=True, eq=False)
class InstrumentedScene:
    """A scene whose channels instruments show: its ports for readings and clocks.

    Attributes:
        instruments: What shows the channels.
    """

    instruments: Instruments = field(default_factory=Instruments)

    play_start = None  # plays begin in their middle

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Self:
        """A copy in which some channels are f(channels (..., width, num_samples), grid)."""
        return replace(self, instruments=self.instruments.with_reading(channels, change))

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Self:
        """A copy in which some channels show what was ``delay`` ago [s]."""
        return replace(self, instruments=self.instruments.with_clock(channels, delay))


def grid_of(run: Run) -> Grid:
    """Samples of a run and nothing in between."""
    return grid_at(torch.from_numpy(np.asarray(run.time_s, dtype=np.float64)))


def grid_at(times: Tensor) -> Grid:
    """Samples at times [s] and nothing in between."""
    return Grid(times, torch.arange(len(times)), times.numpy())


def instrument_causes(
    channels: Sequence[Channel],
    scales: Scales,
    *,
    late_record: bool,
    without: Sequence[str] = (),
    clocks: Collection[tuple[str, ...]] = (),
    system: str = ANY,
) -> Iterator[Effect]:
    """Causes of every instrument of a study, the widest first.

    Args:
        channels: Channels of the study.
        scales: Usual magnitudes of commands and readings.
        late_record: Whether a record that is late as a whole shows as no late command does.
        without: Names of rows that are left out.
        clocks: Channels whose lateness is known or a base parameter, sensor by sensor.
        system: Kind of system.
    """
    for group in channel_groups(channels, late_record=late_record):
        of = instrument_of(group, channels, scales)
        left_out = (*without, "sensor_delay") if group.channels in clocks else without
        for name in rows(SENSOR):
            if name in group.causes and name not in left_out:
                yield reading_cause(name, _with_ending(of, name, group, channels), system=system)


def instrument_of(group: ChannelGroup, channels: Sequence[Channel], scales: Scales) -> Instrument:
    """The instrument that shows a group of channels, its causes named by their rows alone.

    Args:
        group: Channels that causes change alike.
        channels: Channels of the study.
        scales: Usual magnitudes of readings.
    """
    places = tuple(i for i, c in enumerate(channels) if c.name in group.channels)
    own = tuple(channels[i] for i in places)
    usual = scales.of_channels(group.channels)
    return Instrument(own, places, usual, "", own[0].unit, group.causes)


def _with_ending(
    of: Instrument, cause: str, group: ChannelGroup, channels: Sequence[Channel]
) -> Instrument:
    is_whole = not group.name or len(of.channels) == len(channels)
    is_one_kind = len({c.kind for c in channels}) == 1
    is_named = not is_whole or (cause in _NAMED and is_one_kind)
    return replace(of, ending=f"_of_{spell_plainly(group.name)}") if is_named else of


__all__ = [
    "TIMED_COMMANDS",
    "TIMED_READINGS",
    "Instruments",
    "grid_at",
    "grid_of",
    "instrument_causes",
    "instrument_of",
]
