"""Multicopters under recorded commands, and what real ones add to the model."""

from diffsim.identify.effect import Effect
from diffsim.systems.actuator import HELD_DELAY, HELD_LAG
from diffsim.systems.multicopter.effects import COPTER
from diffsim.systems.multicopter.model import CopterModel, flight_model, flight_nuisances
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.multicopter.single_rotors import (
    rotor_tilt,
    thrust_loss,
    torque_loss,
    weak_rotor,
)
from diffsim.systems.multicopter.unknown import unknown_wrench


def copter_library(num_rotors: int = 4) -> tuple[Effect, ...]:
    """Causes in flights; those of single rotors once for each."""
    of_rotors = (weak_rotor, thrust_loss, torque_loss, rotor_tilt)
    single = (of(i) for i in range(num_rotors) for of in of_rotors)
    return (*COPTER, HELD_LAG, HELD_DELAY, *single)


__all__ = [
    "CopterModel",
    "CopterScene",
    "copter_library",
    "flight_model",
    "flight_nuisances",
    "unknown_wrench",
]
