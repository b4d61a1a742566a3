"""Candidate causes by system: the libraries of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable

from diffsim._check import require_choice
from diffsim.diagnose.candidates.actuator import ACTUATOR, CommandDelay
from diffsim.diagnose.candidates.copter import COPTER, weak_rotor
from diffsim.diagnose.candidates.soft_forces import FORCES
from diffsim.diagnose.candidates.soft_material import MATERIAL
from diffsim.diagnose.candidates.soft_sensor import SENSOR
from diffsim.diagnose.effect import Effect


def soft_body_library() -> list[Effect]:
    """Causes in soft bodies and in the cameras that watch them."""
    return [make() for make in (*MATERIAL, *FORCES, *ACTUATOR, *SENSOR)]


def copter_library(num_rotors: int = 4) -> list[Effect]:
    """Causes in flights; one weak-rotor effect per rotor."""
    lag = ACTUATOR[0]
    effects = [make() for make in (*COPTER, lag, CommandDelay)]
    return [*effects, *(weak_rotor(i) for i in range(num_rotors))]


_LIBRARIES: dict[str, Callable[..., list[Effect]]] = {
    "soft_body": soft_body_library,
    "copter": copter_library,
}


def library(system: str, **options: int) -> list[Effect]:
    """Candidate causes of a system.

    Args:
        system: "soft_body" or "copter".
        **options: For "copter": num_rotors, 4 by default.

    Raises:
        ValueError: no such system; the message offers the closest names.
    """
    return _LIBRARIES[require_choice("system", system, _LIBRARIES)](**options)


__all__ = ["library"]
