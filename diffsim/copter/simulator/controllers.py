"""Flight controllers: LQR about the hover (thesis 3.3.3) and the PID baseline, one vehicle each.

What a controller is asked for at one time is a ``Setpoint``.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.dynamics.hover import hover
from diffsim.copter.dynamics.hover_result import HoverError, HoverResult, HoverWarning
from diffsim.copter.dynamics.linearize import linearize
from diffsim.copter.dynamics.lqr import lqr
from diffsim.copter.dynamics.pid import PidController, PidGains
from diffsim.copter.vehicle.multicopter import GRAVITY, Multicopter
from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.core.rotation import matrix_from_quaternion, quaternion_from_rpy


class Controller(Protocol):
    """From the estimated state and targets to thrusts."""

    name: str

    def thrusts(self, state: FlightState, target: Setpoint, dt: float) -> Tensor:
        """Wanted thrusts, (n_rotors,) [N], beyond the motors' limits where it must.

        Args:
            state: Estimate, leading axis (1,).
            target: What to hold.
            dt: Control period [s].
        """

    def reset(self) -> None:
        """Forget everything; called while the motors stand."""


class LqrController:
    """u = u_target - K (x - target) with the gain of the hover, at any heading.

    The gain is that of yaw zero (thesis 3.3.3); errors of position and velocity are turned into
    the frame of the heading. Where the target accelerates, its lean and thrusts are those of a
    hover under the gravity that it feels, to first order. Position errors count up to
    ``max_error``, lest a far target asks for more than the motors have.

    Args:
        vehicle: The design that the controller believes in, its load included.
        state_weight: Q = state_weight I, as in the public tool.
        input_weight: R = input_weight I.
        max_error: Largest error of the position [m].

    Raises:
        HoverError: the vehicle does not hover within its limits, or cannot be controlled there.
        RiccatiError: not stabilizable.
    """

    name = "lqr"

    @checked
    def __init__(
        self,
        vehicle: Multicopter,
        *,
        state_weight: float = 10.0,
        input_weight: float = 1.0,
        max_error: float = 1.0,
    ):
        require_number("state_weight", state_weight, above=0.0)
        require_number("input_weight", input_weight, above=0.0)
        self.max_error = require_number("max_error", max_error, above=0.0)
        vehicle = vehicle.detach()
        trim = flyable_hover(vehicle)
        A, B = linearize(vehicle, trim.thrusts, trim.attitude)
        q = state_weight * torch.eye(12, dtype=torch.float64)
        r = input_weight * torch.eye(vehicle.num_rotors, dtype=torch.float64)
        self.gain = lqr(A, B, q, r).K
        self.trim = trim

    def thrusts(self, state: FlightState, target: Setpoint, dt: float) -> Tensor:
        """See ``Controller``."""
        x = state.minimal()[0]
        heading = _about_z(x[5])
        ahead = heading.T @ (x[:3] - x.new_tensor(target.position))
        slip = heading.T @ (state.velocity[0] - x.new_tensor(target.velocity))
        ax, ay, az = (heading.T @ x.new_tensor(target.acceleration) / GRAVITY).tolist()
        lean = self.trim.attitude + x.new_tensor([ay, -ax])
        if target.hold_attitude:
            ahead[:2], slip[:2] = 0.0, 0.0
            lean = lean + x.new_tensor([target.roll, target.pitch])
        far = max(float(ahead.norm()) / self.max_error, 1.0)
        level = matrix_from_quaternion(quaternion_from_rpy(x[3:6] * x.new_tensor([1.0, 1.0, 0.0])))
        turn = float(x[5]) - target.yaw
        turn = math.atan2(math.sin(turn), math.cos(turn))
        error = torch.cat(
            [
                ahead / far,
                x[3:5] - lean,
                x.new_tensor([turn]),
                level.T @ slip,
                x[9:11],
                x[11:] - target.yaw_rate,
            ]
        )
        return (1.0 - az) * self.trim.thrusts - self.gain @ error

    def reset(self) -> None:
        """There is nothing to forget."""


class PidFlightController:
    """The cascaded PID baseline (``PidController``) with its integral.

    Args:
        vehicle: The design that the controller believes in, its load included.
        gains: ``PidGains()`` by default.
    """

    name = "pid"

    @checked
    def __init__(self, vehicle: Multicopter, *, gains: PidGains | None = None):
        flyable_hover(vehicle.detach())
        self._pid = PidController(vehicle.detach(), gains)
        self._integral = torch.zeros(1, 3, dtype=torch.float64)

    def thrusts(self, state: FlightState, target: Setpoint, dt: float) -> Tensor:
        """See ``Controller``; follows positions only."""
        if target.hold_attitude:
            raise ValueError(
                "the PID controller follows positions; fly attitude sticks with controller 'lqr'"
            )
        place = torch.tensor([target.position], dtype=torch.float64)
        yaw = torch.tensor([target.yaw], dtype=torch.float64)
        wanted, self._integral = self._pid.thrusts(state, place, yaw, self._integral, dt)
        return wanted[0]

    def reset(self) -> None:
        """Empty the integral."""
        self._integral = torch.zeros(1, 3, dtype=torch.float64)


def flyable_hover(vehicle: Multicopter) -> HoverResult:
    """The hover of a vehicle that can be flown about it.

    Raises:
        HoverError: no hover within the limits, or not all of lift, roll, pitch and yaw can be
            commanded there.
    """
    with warnings.catch_warnings():  # what it warns of is raised below
        warnings.simplefilter("ignore", HoverWarning)
        trim = hover(vehicle, on_infeasible="raise")
    if int(trim.free_rank) < 4:
        raise HoverError(
            f"rotors away from their limits command {int(trim.free_rank)} of lift, roll, pitch and "
            f"yaw (all rotors: {int(trim.rank)}); all four are needed to fly: lighten the load, "
            "move rotors, or change axes or spins",
            trim,
        )
    return trim


def _about_z(yaw: Tensor) -> Tensor:
    zero = torch.zeros_like(yaw)
    return matrix_from_quaternion(quaternion_from_rpy(torch.stack([zero, zero, yaw])))


Vector = tuple[float, float, float]


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True)
class Setpoint:
    """Targets of a controller, NED.

    Attributes:
        position: Position of the center of mass, (3,) [m]; with ``hold_attitude`` only its z
            counts.
        velocity: World frame, (3,) [m/s]; with ``hold_attitude`` only its z counts.
        acceleration: World frame, (3,) [m/s^2]; 0 where it is not known ahead, or holding attitude.
        yaw: Yaw angle that is asked for [rad].
        yaw_rate: Yaw rate [rad/s].
        roll, pitch: Beyond those of the hover [rad]; with ``hold_attitude`` only.
        hold_attitude: Hold roll and pitch instead of the place.
        motors_on: False: all motors stand.
    """

    position: Vector
    velocity: Vector = (0.0, 0.0, 0.0)
    acceleration: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    yaw_rate: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    hold_attitude: bool = False
    motors_on: bool = True


class Pilot(Protocol):
    """A mission, or somebody at the sticks."""

    @property
    def duration(self) -> float | None:
        """Duration of the flight [s]; None: endless."""

    def setpoint(self, time: float) -> Setpoint:
        """Targets at a time since the start [s]; times do not go back."""
