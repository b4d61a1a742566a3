"""Causes in the instruments that show channels, for every kind of system alike."""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
import torch
from torch import Tensor

from diffsim.causes.channel_groups import WHOLE, ChannelGroup
from diffsim.causes.ports import on_clock, on_readings
from diffsim.causes.row import ANY, Row, spell_plainly
from diffsim.causes.scales import Scales
from diffsim.causes.scene import PLAY_START
from diffsim.core.checked import checked
from diffsim.data.study import Channel, Run
from diffsim.identify.effect import Effect

SENSOR = "sensor"  # the table
_OF_EACH = ("sensor_offset", "sensor_drift")  # with a size for each channel
_IN_TURN = ("bus_age",)  # of which each channel has one size more than the one before it


@checked
@dataclass(frozen=True)
class Instrument:
    """Channels that causes change alike.

    Attributes:
        channels: Channels that the instrument shows.
        places: Their indices among all channels of the study.
        scales: Usual magnitudes: ``longest``, duration of the longest run [s]; ``middle`` and
            ``width`` of what the channels have shown.
        ending: What names of causes end with, such as "_of_camera".
        causes: Names of the rows that are tried.
        unit: Unit of the channels.
    """

    channels: tuple[Channel, ...]
    places: tuple[int, ...]
    scales: Mapping[str, float]
    ending: str
    unit: str
    causes: tuple[str, ...] = WHOLE

    def __post_init__(self) -> None:
        object.__setattr__(self, "scales", MappingProxyType(dict(self.scales)))


def cause_of_readings(row: Row, of: Instrument, *, system: str = ANY) -> Effect:
    """A cause in an instrument, by its row."""
    is_in_unit = row.unit == "channel"
    is_in_turn = row.name in _IN_TURN
    several = row.name in _OF_EACH and len(of.channels) > 1
    shown = {c.shown_unit for c in of.channels} if is_in_unit else {row.shown}
    return row.effect(
        on_clock(of.places, in_turn=is_in_turn)
        if row.at == "clock"
        else on_readings(row, of.places, of.scales),
        of.scales,
        system=system,
        ending=of.ending,
        unit=of.unit if is_in_unit else row.unit,
        shown_unit=shown.pop() if len(shown) == 1 else None,
        components=tuple(c.name for c in of.channels) if several else row.components,
    )


_NAMED = ("sensor_offset", "sensor_drift")  # after the kind, even where there is no other


def instrument_of(group: ChannelGroup, channels: Sequence[Channel], scales: Scales) -> Instrument:
    """The instrument that shows a group of channels, its causes named by their rows alone.

    Args:
        scales: Usual magnitudes of readings.
    """
    places = tuple(i for i, c in enumerate(channels) if c.name in group.channels)
    own = tuple(channels[i] for i in places)
    usual = scales.of_channels(group.channels)
    return Instrument(own, places, usual, "", own[0].unit, group.causes)


def with_ending(
    of: Instrument, cause: str, group: ChannelGroup, channels: Sequence[Channel]
) -> Instrument:
    """An instrument with what one of its causes is called, where there are others.

    Args:
        cause: Name of the row.
    """
    is_whole = not group.name or len(of.channels) == len(channels)
    is_one_kind = len({c.kind for c in channels}) == 1
    is_named = not is_whole or (cause in _NAMED and is_one_kind)
    return replace(of, ending=f"_of_{spell_plainly(group.name)}") if is_named else of


def with_play_start(values: Mapping[str, Tensor], run: Run) -> Mapping[str, Tensor]:
    """Values of base parameters; a run that the model was not made for starts in the middle."""
    name = f"{PLAY_START}@{run.name}"
    if name in values:
        return values
    middle = {name: torch.zeros((), dtype=torch.float64)}
    return ChainMap(middle, values)  # type: ignore[arg-type]  # it is only read


def pace(effect: Effect, sample_s: float) -> Effect:
    """A delay or lag that may be as long as half a sample without surprise; others as they are.

    What is read every two seconds is seldom late by milliseconds.

    Args:
        sample_s: Usual time between two samples [s].
    """
    least = 0.5 * sample_s
    is_short = effect.unit == "s" and effect.typical < least
    return replace(effect, typical=least) if is_short else effect


def usual_sample(runs: Iterable[Run]) -> float:
    """Usual time between two samples of runs [s]; 0 where none has two."""
    return max((float(np.median(np.diff(r.time_s))) for r in runs if len(r.time_s) > 1), default=0)
