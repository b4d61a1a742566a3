"""The candidate causes of a described system that moves, in their order."""

from __future__ import annotations

from collections.abc import Mapping

from diffsim.causes.plant import IN_TIME, Place, Plant
from diffsim.causes.readings import pace, usual_sample
from diffsim.causes.row import Row
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.ode.event_effects import event_effects
from diffsim.systems.ode.input_effects import input_effects
from diffsim.systems.ode.law_effects import law_effects
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.place_effects import magnitudes_at, place_effects, push_at
from diffsim.systems.ode.refresh_effects import refresh_effects
from diffsim.systems.ode.sensor_effects import sensor_effects
from diffsim.systems.ode.store_effects import store_effects


def ode_effects(library: Library, periods: Mapping[str, float]) -> tuple[Effect, ...]:
    """Causes at places and stores, of inputs and of sensors, in time, of laws, and the user's own.

    Args:
        library: Names and magnitudes of the system.
        periods: Period of each channel's own clock [s]; 0 where there is none.
    """
    timed = (*input_effects(library), *sensor_effects(library))
    return (
        *place_effects(library),
        *store_effects(library),
        *pace(timed, usual_sample(library.study.runs)),
        *refresh_effects(library, periods),
        *event_effects(library),
        *law_effects(library),
        *library.system.own,
    )


def plant_of(library: Library) -> Plant:
    """What a system of formulas tells of itself.

    Args:
        library: Names and magnitudes of the system.
    """
    system = library.system
    places = {place.name: (place, scale) for place, scale in library.places}

    def push(row: Row, name: str) -> Apply:
        return push_at(library, *places[name], row, row.name)

    return Plant(
        kind="ode",
        scales=library.scales,
        channels=library.study.channels,
        commands={name: "held" if held else "straight" for name, held in system.held.items()},
        numbers=tuple(system.base.quantities),
        places={name: Place(magnitudes_at(scale)) for name, (_, scale) in places.items()},
        facts={IN_TIME: True},
        push=push,
    )
