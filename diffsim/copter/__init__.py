"""Multicopters: parts, composition, dynamics, hover and LQR layers, co-design, flight, fabrication.

World and body frames are north-east-down (NED): x forward, y right, z down; up is -z. The body
frame sits at the centre of mass.
"""

from diffsim.copter.battery import Battery
from diffsim.copter.effects import FlightEffects
from diffsim.copter.flight import Feedback, Flight, FlightError, fly
from diffsim.copter.flight_state import FlightState
from diffsim.copter.rotor import RotorModel, rotor_model, rotor_names
from diffsim.copter.vehicle import GRAVITY, Multicopter

__all__ = [
    "GRAVITY",
    "Battery",
    "Feedback",
    "Flight",
    "FlightEffects",
    "FlightError",
    "FlightState",
    "Multicopter",
    "RotorModel",
    "fly",
    "rotor_model",
    "rotor_names",
]
