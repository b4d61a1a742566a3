"""Multicopters under recorded commands, and what real ones add to the model."""

from diffsim.diagnose.beds.actuator import HeldDelay, HeldLag
from diffsim.diagnose.beds.copter.effects import COPTER, weak_rotor
from diffsim.diagnose.beds.copter.model import CopterModel, flight_model, flight_nuisances
from diffsim.diagnose.beds.copter.scene import CopterScene
from diffsim.diagnose.beds.copter.unknown import unknown_wrench
from diffsim.diagnose.effect import Effect


def copter_library(num_rotors: int = 4) -> tuple[Effect, ...]:
    """Causes in flights; one weak-rotor effect per rotor."""
    effects = tuple(make() for make in (*COPTER, HeldLag, HeldDelay))
    return (*effects, *(weak_rotor(i) for i in range(num_rotors)))


__all__ = [
    "CopterModel",
    "CopterScene",
    "copter_library",
    "flight_model",
    "flight_nuisances",
    "unknown_wrench",
]
