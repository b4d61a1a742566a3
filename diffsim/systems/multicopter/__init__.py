"""Multicopters under recorded commands, and what real ones add to the model."""

from diffsim.systems.multicopter.causes import copter_plant
from diffsim.systems.multicopter.extended import ExtendedCopter
from diffsim.systems.multicopter.model import CopterModel
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.multicopter.unknown import unknown_wrench

__all__ = [
    "CopterModel",
    "CopterScene",
    "ExtendedCopter",
    "copter_plant",
    "unknown_wrench",
]
