"""Multicopters: parts, composition, dynamics, hover and LQR layers, co-design, flight, fabrication.

World and body frames are north-east-down (NED): x forward, y right, z down; up is -z. The body
frame sits at the centre of mass.
"""

from diffsim.copter.clearance import disc_clearances, min_clearance
from diffsim.copter.control_metrics import (
    control_authority,
    controllability,
    hover_map_singular_value,
    max_hover_weight,
    response_time,
    rotor_out_margins,
)
from diffsim.copter.hover import Hover, hover, hover_thrusts
from diffsim.copter.hover_result import HoverError, HoverResult, HoverWarning
from diffsim.copter.linearise import LinearModel, linearise, state_rate
from diffsim.copter.lqr import LQR, LqrGain, lqr, lqr_stats, lyapunov
from diffsim.copter.stabilizability import RiccatiError
from diffsim.copter.vehicle import GRAVITY, Multicopter

__all__ = [
    "GRAVITY",
    "LQR",
    "Hover",
    "HoverError",
    "HoverResult",
    "HoverWarning",
    "LinearModel",
    "LqrGain",
    "Multicopter",
    "RiccatiError",
    "control_authority",
    "controllability",
    "disc_clearances",
    "hover",
    "hover_map_singular_value",
    "hover_thrusts",
    "linearise",
    "lqr",
    "lqr_stats",
    "lyapunov",
    "max_hover_weight",
    "min_clearance",
    "response_time",
    "rotor_out_margins",
    "state_rate",
]
