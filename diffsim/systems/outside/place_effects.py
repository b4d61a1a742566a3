"""Forces with a law of their own at the places of an outside simulator."""

from __future__ import annotations

from diffsim.causes.catalogue import rows
from diffsim.causes.ports import on_place
from diffsim.causes.row import spell_plainly
from diffsim.identify.effect import Effect
from diffsim.systems.outside.hooks import Place

ALWAYS = ("constant_force",)
OF_DISTANCE = ("added_spring", "cubic_stiffness")
OF_SPEED = ("viscous_friction", "dry_friction", "square_drag")


def place_effects(place: Place) -> list[Effect]:
    """Forces at a place: springs where its distance is told, friction where its speed is.

    Args:
        place: Place with the scales of force, displacement and speed.
    """
    names = [*ALWAYS]
    names += OF_DISTANCE if place.distance is not None else ()
    names += OF_SPEED if place.speed is not None else ()
    scales = {
        "push": place.typical,
        "distance": place.distance or 1.0,
        "speed": place.speed or 1.0,
    }
    return [
        row.effect(
            on_place(row, place.name),
            scales,
            ending=f"_at_{spell_plainly(place.name)}",
            unit=row.unit.replace("F", place.unit).replace("X", place.length),
        )
        for row in (rows("force")[name] for name in names)
    ]
