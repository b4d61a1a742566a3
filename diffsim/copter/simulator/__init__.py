"""Simulated flights in closed loop with sensors, pulses, battery and a pilot (thesis 3.5, 3.7)."""

from diffsim.copter.simulator.controllers import (
    Controller,
    LqrController,
    PidFlightController,
    Pilot,
    Setpoint,
)
from diffsim.copter.simulator.flight_simulator import CONTROLLERS, FlightSimulator, Ground
from diffsim.copter.simulator.log import FlightLog, FlightSample
from diffsim.copter.simulator.mission import (
    Leg,
    Mission,
    load_mission,
    mission_from_text,
    shipped_missions,
)
from diffsim.copter.simulator.outputs import SAFE_PWM, MotorOutputs, flight_rotors
from diffsim.copter.simulator.pacing import Pacer
from diffsim.copter.simulator.payload import PayloadError, payload_limit, with_payload
from diffsim.copter.simulator.sensing import FlightSensors
from diffsim.copter.simulator.sticks import (
    RecordedSticks,
    StickPilot,
    Sticks,
    StickScale,
    Transmitter,
    example_sticks,
    load_sticks,
)

__all__ = [
    "CONTROLLERS",
    "SAFE_PWM",
    "Controller",
    "FlightLog",
    "FlightSample",
    "FlightSensors",
    "FlightSimulator",
    "Ground",
    "Leg",
    "LqrController",
    "Mission",
    "MotorOutputs",
    "Pacer",
    "PayloadError",
    "PidFlightController",
    "Pilot",
    "RecordedSticks",
    "Setpoint",
    "StickPilot",
    "StickScale",
    "Sticks",
    "Transmitter",
    "example_sticks",
    "flight_rotors",
    "load_mission",
    "load_sticks",
    "mission_from_text",
    "payload_limit",
    "shipped_missions",
    "with_payload",
]
