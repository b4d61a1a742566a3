"""The library of a described system: all candidate causes but the user's own."""

from __future__ import annotations

from diffsim.causes.plant import IN_TIME, Place, Plant
from diffsim.causes.readings import pace, usual_sample
from diffsim.causes.row import Row
from diffsim.identify.effect import Apply, Effect
from diffsim.systems.ode.input_effects import input_effects
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.place_effects import magnitudes_at, place_effects, push_at
from diffsim.systems.ode.sensor_effects import sensor_effects
from diffsim.systems.ode.store_effects import store_effects


def ode_effects(library: Library) -> tuple[Effect, ...]:
    """Causes at places and stores, of inputs and of sensors."""
    timed = (*input_effects(library), *sensor_effects(library))
    return (
        *place_effects(library),
        *store_effects(library),
        *pace(timed, usual_sample(library.study.runs)),
    )


def plant_of(library: Library, numbers: tuple[str, ...]) -> Plant:
    """What a system of formulas tells of itself.

    Args:
        library: Names and magnitudes of the system.
        numbers: Names of its numbers.
    """
    places = {place.name: (place, scale) for place, scale in library.places}

    def push(row: Row, name: str) -> Apply:
        return push_at(library, *places[name], row, row.name)

    return Plant(
        kind="ode",
        scales=library.scales,
        channels=library.study.channels,
        commands={name: "held" if held else "straight" for name, held in library.held.items()},
        numbers=numbers,
        places={name: Place(magnitudes_at(scale)) for name, (_, scale) in places.items()},
        facts={IN_TIME: True},
        push=push,
    )
