"""Fabrication plans: what to cut, print, buy and wire (thesis 3.6)."""

from diffsim.copter.fabrication.files import write_plan
from diffsim.copter.fabrication.motors import MotorPlan
from diffsim.copter.fabrication.overlap import Overlap, overlaps
from diffsim.copter.fabrication.planner import FabricationError, FabricationPlan, PrintedPart, plan
from diffsim.copter.fabrication.print_check import PrintCheck, Printer
from diffsim.copter.fabrication.printable import clip_mesh
from diffsim.copter.fabrication.rods import RodCut, StockBar

__all__ = [
    "FabricationError",
    "FabricationPlan",
    "MotorPlan",
    "Overlap",
    "PrintCheck",
    "PrintedPart",
    "Printer",
    "RodCut",
    "StockBar",
    "clip_mesh",
    "overlaps",
    "plan",
    "write_plan",
]
