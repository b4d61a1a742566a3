"""Soft bodies as a study describes them, and what real ones add to it."""

from diffsim.causes.commands import ACTUATOR
from diffsim.identify.effect import Effect
from diffsim.systems.soft_body.forces import FORCES
from diffsim.systems.soft_body.material import MATERIAL
from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.scene import SoftScene
from diffsim.systems.soft_body.sensor import SENSOR
from diffsim.systems.soft_body.support import SUPPORT_MOTION
from diffsim.systems.soft_body.unknown import unknown_force


def soft_body_library() -> tuple[Effect, ...]:
    """Causes in soft bodies, around them, in their actuators and in the cameras."""
    return (*MATERIAL, *FORCES, SUPPORT_MOTION, *ACTUATOR, *SENSOR)


__all__ = [
    "SUPPORT_MOTION",
    "SoftModel",
    "SoftScene",
    "soft_body_library",
    "unknown_force",
]
