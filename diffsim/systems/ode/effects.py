"""The library of a described system: all candidate causes but the user's own."""

from __future__ import annotations

from diffsim.causes.readings import pace, usual_sample
from diffsim.identify.effect import Effect
from diffsim.systems.ode.input_effects import input_effects
from diffsim.systems.ode.library import Library
from diffsim.systems.ode.place_effects import place_effects
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
