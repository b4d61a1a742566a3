"""Which channels a cause in the instruments changes alike: those of one sensor, kind, or one only.

A camera is late in all that it shows and in nothing else, whatever kinds of quantities that are. A
study may say which ``sensor`` shows a channel. Where it does not, causes are tried for the channels
of one kind and, where a kind has few, for each channel alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import did_you_mean
from diffsim.data.study import Channel
from diffsim.data.study_check import Problem

MAX_SINGLE_CHANNELS = 4  # channels of a kind, up to which each is tried alone
FEWEST_ON_BUS = 3  # channels of a kind whose age may grow from one to the next
CLOCK = ("sensor_delay", "sensor_lag")
ZERO = ("sensor_offset", "sensor_drift")  # one size for each channel anyway
READING = ("sensor_scale", "sensor_backlash")
BUS = "bus_age"
TURN = "orientation"  # kind of channels, parts of a turn, which have no scale and no zero
WHOLE = (*CLOCK, *ZERO, *READING, "sensor_curvature")

CLOCKS = (
    "How late sensors, kinds or single channels are, by their name: "
    "{camera: {value: 0, sd: 20 ms, per: run}} fits a clock for each run. Where none is stated, "
    "lateness is a cause"
)


@dataclass(frozen=True)
class ChannelGroup:
    """Channels that a cause changes alike."""

    name: str  # what causes are named after; empty: all channels of the study
    channels: tuple[str, ...]  # names of the channels
    causes: tuple[str, ...] = WHOLE  # names of the causes that are tried, without what they are of


def channel_groups(channels: Sequence[Channel], *, late_record: bool) -> tuple[ChannelGroup, ...]:
    """Dials of a study, the widest first.

    Args:
        late_record: Whether a record that is late as a whole shows as no late command does.
    """
    stated = any(c.sensor is not None for c in channels)
    found = _by_sensor(channels) if stated else _by_kind(channels)
    turns = {c.name for c in channels if c.kind == TURN}
    everything = tuple(c.name for c in channels)
    if all(d.channels != everything for d in found):
        found.insert(0, ChannelGroup("", everything, ("sensor_delay",)))
    out = []
    for group in found:
        is_whole = group.channels == everything
        on_bus = (BUS,) if len(group.channels) >= FEWEST_ON_BUS and group.causes == WHOLE else ()
        causes = tuple(
            c
            for c in (CLOCK if turns.issuperset(group.channels) else group.causes)
            if c in group.causes and (late_record or not is_whole or c != "sensor_delay")
        )
        if causes:
            out.append(ChannelGroup(group.name, group.channels, (*causes, *on_bus)))
    return tuple(out)


def clock_of(name: str) -> str:
    """Name of the parameter that says how late a sensor, kind or channel is."""
    return f"clock_of_{name}"


def channels_of(channels: Sequence[Channel], name: str) -> tuple[str, ...]:
    """Channels of a sensor, of a kind, or the channel of that name, whichever there is first.

    Raises:
        ValueError: nothing is called so.
    """
    for called in ("sensor", "kind", "name"):
        found = tuple(c.name for c in channels if getattr(c, called) == name)
        if found:
            return found
    known = dict.fromkeys(n for c in channels for n in (c.sensor, c.kind, c.name) if n is not None)
    raise ValueError(
        f"no sensor, kind or channel {name!r}{did_you_mean(name, list(known))}; "
        f"known: {', '.join(known)}"
    )


def delays_of(late: Sequence[tuple[tuple[int, ...], Tensor]]) -> dict[tuple[int, ...], Tensor]:
    """How late channels are, those together that share all instruments [s].

    Args:
        late: Channels of an instrument by their indices, and how late it is; added up.
    """
    alike: dict[tuple[int, ...], list[int]] = {}
    for k in sorted({k for channels, _ in late for k in channels}):
        of = tuple(i for i, (channels, _) in enumerate(late) if k in channels)
        alike.setdefault(of, []).append(k)
    every = [delay for _, delay in late]
    return {
        tuple(own): torch.stack(torch.broadcast_tensors(*(every[i] for i in of))).sum(0)
        for of, own in alike.items()
    }


def clock_problems(channels: Sequence[Channel], clocks: Iterable[str]) -> Iterator[Problem]:
    """Clocks of what there is not.

    Args:
        clocks: Names that a description gives clocks.
    """
    for name in clocks:
        try:
            channels_of(channels, name)
        except ValueError as error:
            yield Problem("error", f"model.clocks.{name}", str(error))


def _by_sensor(channels: Sequence[Channel]) -> list[ChannelGroup]:
    """One clock for each sensor; what has a unit for each of its kinds."""
    out = []
    for sensor, own in _group_by_name(channels, [c.sensor or c.kind for c in channels]).items():
        kinds = _group_by_name(own, [c.kind for c in own])
        if len(kinds) == 1:
            out.append(ChannelGroup(sensor, _names(own)))
            continue
        out.append(ChannelGroup(sensor, _names(own), CLOCK))
        rest = tuple(c for c in WHOLE if c not in CLOCK)
        out += [
            ChannelGroup(f"{kind}_of_{sensor}", _names(part), rest) for kind, part in kinds.items()
        ]
    return out


def _by_kind(channels: Sequence[Channel]) -> list[ChannelGroup]:
    """Every kind; where it has few channels, each of them as well."""
    kinds = _group_by_name(channels, [c.kind for c in channels])
    out = [ChannelGroup(kind, _names(own)) for kind, own in kinds.items()]
    for own in kinds.values():
        if 1 < len(own) <= MAX_SINGLE_CHANNELS:
            for channel in own:
                name = channel.name if channel.name not in kinds else f"channel_{channel.name}"
                out.append(ChannelGroup(name, (channel.name,), (*CLOCK, *READING)))
    return out


def _group_by_name(channels: Sequence[Channel], names: Sequence[str]) -> dict[str, list[Channel]]:
    out: dict[str, list[Channel]] = {}
    for channel, name in zip(channels, names, strict=True):
        out.setdefault(name, []).append(channel)
    return out


def _names(channels: Sequence[Channel]) -> tuple[str, ...]:
    return tuple(c.name for c in channels)
