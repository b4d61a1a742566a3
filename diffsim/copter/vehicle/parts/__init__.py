"""Parametric parts of multicopters and their database."""

from diffsim.copter.vehicle.parts.database import PART_KINDS, make_part
from diffsim.copter.vehicle.parts.part import Parameter, Part, RotorMount
from diffsim.copter.vehicle.parts.rotors import ROTOR_NAMES, RotorData, rotor_data

__all__ = [
    "PART_KINDS",
    "ROTOR_NAMES",
    "Parameter",
    "Part",
    "RotorData",
    "RotorMount",
    "make_part",
    "rotor_data",
]
