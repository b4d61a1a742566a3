"""Causes between the system and what was recorded."""

from __future__ import annotations

from diffsim.causes.catalogue import rows
from diffsim.causes.channel_groups import ChannelGroup, channel_groups
from diffsim.causes.readings import Instrument, reading_cause
from diffsim.causes.row import spell_plainly
from diffsim.identify.effect import Effect
from diffsim.systems.ode.library import Library

PER_CHANNEL = ("sensor_offset", "sensor_drift")


def sensor_effects(library: Library) -> tuple[Effect, ...]:
    """Causes of every instrument; offset and drift for each channel."""
    late_record = library.scales.facts["begins_moving"] or not library.held
    groups = channel_groups(library.study.channels, late_record=late_record)
    return tuple(effect for group in groups for effect in _list_causes(library, group))


def _list_causes(library: Library, group: ChannelGroup) -> list[Effect]:
    names = [c.name for c in library.study.channels]
    own = tuple(library.study.channels[names.index(name)] for name in group.channels)
    is_whole = not group.name or len(own) == len(names)
    of_one_kind = len({c.kind for c in library.study.channels}) == 1
    out = []
    for cause in rows("sensor"):
        if cause not in group.causes:
            continue
        if cause == "sensor_delay" and group.channels in library.clocks:
            continue
        is_named = not is_whole or (cause in PER_CHANNEL and of_one_kind)
        instrument = Instrument(
            own,
            tuple(names.index(name) for name in group.channels),
            library.scales.of_channels(group.channels),
            f"_of_{spell_plainly(group.name)}" if is_named else "",
            own[0].unit,
        )
        out.append(reading_cause(cause, instrument, system="ode"))
    return out
