"""Soft bodies as a study describes them, and what real ones add to it."""

from diffsim.systems.soft_body.model import SoftModel
from diffsim.systems.soft_body.scene import SoftScene
from diffsim.systems.soft_body.unknown import unknown_force

__all__ = [
    "SoftModel",
    "SoftScene",
    "unknown_force",
]
