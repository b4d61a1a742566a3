"""Soft bodies: a clamped bar let go or pulled by a tendon, and what real ones add to it."""

from diffsim.diagnose.beds.actuator import ACTUATOR
from diffsim.diagnose.beds.soft.forces import FORCES
from diffsim.diagnose.beds.soft.material import MATERIAL
from diffsim.diagnose.beds.soft.model import SoftModel
from diffsim.diagnose.beds.soft.models import beam_model, tendon_model
from diffsim.diagnose.beds.soft.scene import SoftScene
from diffsim.diagnose.beds.soft.sensor import SENSOR
from diffsim.diagnose.beds.soft.support import SupportMotion
from diffsim.diagnose.beds.soft.unknown import unknown_force
from diffsim.diagnose.effect import Effect


def soft_body_library() -> tuple[Effect, ...]:
    """Causes in soft bodies, around them, in their actuators and in the cameras."""
    return tuple(make() for make in (*MATERIAL, *FORCES, SupportMotion, *ACTUATOR, *SENSOR))


__all__ = [
    "SoftModel",
    "SoftScene",
    "SupportMotion",
    "beam_model",
    "soft_body_library",
    "tendon_model",
    "unknown_force",
]
