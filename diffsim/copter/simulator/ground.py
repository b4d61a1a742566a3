"""Level ground at height zero, where flights start and end."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from diffsim.copter.dynamics.flight import FlightError
from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.core.check import require_number


class Ground:
    """Holds a vehicle that touches it: at rest, level, its heading kept.

    No bouncing, sliding or tipping; a harder touch than the limits is a crash.

    Args:
        max_speed: Largest speed of touching down [m/s].
        max_tilt: At touch-down [rad].
    """

    def __init__(self, *, max_speed: float = 1.5, max_tilt: float = math.radians(40.0)):
        self.max_speed = require_number("max_speed", max_speed, above=0.0)
        self.max_tilt = require_number("max_tilt", max_tilt, above=0.0)

    def hold(self, state: FlightState, step: int) -> FlightState:
        """The state, or that of standing where it is at the ground or below.

        Args:
            state: Leading axis (1,).
            step: Control step, for the error message.

        Raises:
            FlightError: a crash.
        """
        if float(state.position[0, 2]) < 0.0:
            return state
        speed = float(state.velocity[0].norm())
        tilt = math.acos(max(-1.0, min(1.0, float(state.rotation[0, 2, 2]))))
        if speed > self.max_speed or tilt > self.max_tilt:
            raise FlightError(
                f"crashed in step {step}: hit the ground at {speed:.2f} m/s and "
                f"{math.degrees(tilt):.0f} degrees of tilt, allowed {self.max_speed:g} m/s and "
                f"{math.degrees(self.max_tilt):.0f} degrees; fly slower, lighter or higher",
                vehicle=0,
                step=step,
            )
        position = state.position * state.position.new_tensor([1.0, 1.0, 0.0])
        rpy = state.rpy * state.position.new_tensor([0.0, 0.0, 1.0])
        return replace(
            FlightState.at_rest(position, rpy), thrusts=state.thrusts, charge=state.charge
        )

    @staticmethod
    def start() -> FlightState:
        """Standing at the origin, heading north, leading axis (1,)."""
        return FlightState.at_rest(torch.zeros(1, 3, dtype=torch.float64))
