"""Multicopters under recorded commands, and what real ones add to the model."""

from diffsim.causes.commands import HELD_DELAY, HELD_LAG
from diffsim.identify.effect import Effect
from diffsim.systems.multicopter.candidates import thrust_steps
from diffsim.systems.multicopter.effects import COPTER
from diffsim.systems.multicopter.model import CopterModel, flight_model, flight_nuisances
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.multicopter.single_rotors import of_each_rotor
from diffsim.systems.multicopter.unknown import unknown_wrench


def copter_library(num_rotors: int = 4) -> tuple[Effect, ...]:
    """Causes in flights; those of single rotors once for each."""
    return (
        thrust_steps(1.0, num_rotors),
        *COPTER,
        HELD_LAG,
        HELD_DELAY,
        *of_each_rotor(num_rotors),
    )


__all__ = [
    "CopterModel",
    "CopterScene",
    "copter_library",
    "flight_model",
    "flight_nuisances",
    "unknown_wrench",
]
