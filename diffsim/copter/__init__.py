"""Multicopters: parts, composition, dynamics, hover and LQR layers, co-design, flight, fabrication.

World and body frames are north-east-down (NED): x forward, y right, z down; up is -z. The body
frame sits at the centre of mass.
"""

from diffsim.copter.assemble import build_design
from diffsim.copter.constraints import InfeasibleDesignError
from diffsim.copter.design import Design
from diffsim.copter.design_file import load_design, save_design, shipped_designs
from diffsim.copter.import_xml import import_xml
from diffsim.copter.listing import PartEntry
from diffsim.copter.spec import Connection, DesignSpec, PartSpec
from diffsim.copter.vehicle import GRAVITY, Multicopter

__all__ = [
    "GRAVITY",
    "Connection",
    "Design",
    "DesignSpec",
    "InfeasibleDesignError",
    "Multicopter",
    "PartEntry",
    "PartSpec",
    "build_design",
    "import_xml",
    "load_design",
    "save_design",
    "shipped_designs",
]
