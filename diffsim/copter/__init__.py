"""Multicopters: parts, composition, dynamics, hover and LQR layers, co-design, flight, fabrication.

World and body frames are north-east-down (NED): x forward, y right, z down; up is -z. The body
frame sits at the center of mass.
"""

from diffsim.copter.design.constraints import InfeasibleDesignError
from diffsim.copter.design.design import Design, build_design
from diffsim.copter.design.design_file import load_design, save_design
from diffsim.copter.design.listing import PartEntry
from diffsim.copter.design.spec import Connection, DesignSpec, PartSpec
from diffsim.copter.design.spec_file import shipped_designs
from diffsim.copter.dynamics.control_metrics import (
    control_authority,
    controllability,
    hover_map_singular_value,
    max_hover_weight,
    response_time,
    rotor_out_margins,
)
from diffsim.copter.dynamics.flight import (
    Feedback,
    Flight,
    FlightError,
    PreparedFlight,
    fly,
    prepare_flight,
)
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.dynamics.hover import Hover, hover, hover_thrusts
from diffsim.copter.dynamics.hover_result import HoverError, HoverResult, HoverWarning
from diffsim.copter.dynamics.linearize import LinearModel, linearize, state_rate
from diffsim.copter.dynamics.lqr import LQR, LqrGain, lqr, lqr_stats, lyapunov
from diffsim.copter.dynamics.stabilizability import RiccatiError
from diffsim.copter.exchange.import_xml import import_xml
from diffsim.copter.exchange.vehicle_file import load_vehicle
from diffsim.copter.vehicle.battery import Battery
from diffsim.copter.vehicle.clearance import disc_clearances, min_clearance
from diffsim.copter.vehicle.effects import BodyDrag, FlightEffects, MotorLag
from diffsim.copter.vehicle.multicopter import GRAVITY, Fleet, Multicopter
from diffsim.copter.vehicle.rotor import RotorModel, motor_lag, rotor_model, rotor_names
from diffsim.copter.vehicle.vehicle_record import FlyingVehicle

__all__ = [
    "GRAVITY",
    "LQR",
    "Battery",
    "BodyDrag",
    "Connection",
    "Design",
    "DesignSpec",
    "Feedback",
    "Fleet",
    "Flight",
    "FlightEffects",
    "FlightError",
    "FlightState",
    "FlyingVehicle",
    "Hover",
    "HoverError",
    "HoverResult",
    "HoverWarning",
    "InfeasibleDesignError",
    "LinearModel",
    "LqrGain",
    "MotorLag",
    "Multicopter",
    "PartEntry",
    "PartSpec",
    "PreparedFlight",
    "RiccatiError",
    "RotorModel",
    "build_design",
    "control_authority",
    "controllability",
    "disc_clearances",
    "fly",
    "hover",
    "hover_map_singular_value",
    "hover_thrusts",
    "import_xml",
    "linearize",
    "load_design",
    "load_vehicle",
    "lqr",
    "lqr_stats",
    "lyapunov",
    "max_hover_weight",
    "min_clearance",
    "motor_lag",
    "prepare_flight",
    "response_time",
    "rotor_model",
    "rotor_names",
    "rotor_out_margins",
    "save_design",
    "shipped_designs",
    "state_rate",
]
