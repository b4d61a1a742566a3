"""Causes between the system and what was recorded."""

from __future__ import annotations

from diffsim.causes.readings import instrument_causes
from diffsim.identify.effect import Effect
from diffsim.systems.ode.library import Library


def sensor_effects(library: Library) -> tuple[Effect, ...]:
    """Causes of every instrument; offset and drift for each channel."""
    return tuple(
        instrument_causes(
            library.study.channels,
            library.scales,
            late_record=library.scales.facts["begins_moving"] or not library.system.held,
            clocks=frozenset(library.system.clocks.values()),
            system="ode",
        )
    )
