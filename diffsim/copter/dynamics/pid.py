"""A cascaded PID baseline: position -> velocity -> attitude -> rates -> thrusts, batched."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.multicopter import GRAVITY, Multicopter
from diffsim.core.check import require_number


@dataclass(frozen=True, kw_only=True)
class PidGains:
    """Gains of the cascade, angular ones per unit of inertia."""

    position: float = 1.5  # wanted velocity per position error [1/s]
    velocity: float = 3.0  # wanted acceleration per velocity error [1/s]
    integral: float = 1.0  # wanted acceleration per integral of the velocity error [1/s^2]
    attitude: float = 8.0  # wanted rate per angle [1/s]
    rate: float = 20.0  # wanted angular acceleration per rate error [1/s]
    max_speed: float = 5.0  # wanted speeds are no larger [m/s]
    # largest angle of the commanded thrust from the vertical [rad]
    max_tilt: float = math.radians(35.0)
    # velocity errors count in the integral up to this, lest it winds up [m/s]
    max_slip: float = 0.3
    max_integral: float = 3.0  # largest acceleration of the integral, per axis [m/s^2]

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require_number(name, value, at_least=0.0)
        require_number("max_tilt", self.max_tilt, above=0.0, below=math.pi / 2)


class PidController:
    """Thrust commands of one vehicle design for a batch of states; differentiable.

    Made for rotors that all point up (body -z); where they do not, the pseudo-inverse of the
    torques and the upward force leaves the sideways force to the position loop.

    Args:
        vehicle: The design that the controller believes in.
        gains: ``PidGains()`` by default.
    """

    def __init__(self, vehicle: Multicopter, gains: PidGains | None = None):
        self.vehicle = vehicle
        self.gains = PidGains() if gains is None else gains
        wrench = torch.cat([vehicle.force_matrix[2:], vehicle.torque_matrix])
        if int(torch.linalg.matrix_rank(wrench.detach())) < 4:
            raise ValueError(
                "vehicle has no rotors for lift, roll, pitch and yaw apart (rank of the effects "
                "below 4); change positions, spins or directions"
            )
        self._mixer = torch.linalg.pinv(wrench)

    def thrusts(
        self, state: FlightState, target: Tensor, yaw: Tensor, integral: Tensor, dt: float
    ) -> tuple[Tensor, Tensor]:
        """Commands for the coming control period, and the integral carried to the next.

        Args:
            state: Leading axis (batch,).
            target: Position, (batch, 3) [m].
            yaw: Yaw angle, (batch,) [rad].
            integral: Acceleration of the integral term, (batch, 3) [m/s^2]; zeros at first.
            dt: Control period [s].

        Returns:
            Thrusts within bounds, (batch, n_rotors) [N], and the integral, (batch, 3).
        """
        g, vehicle = self.gains, self.vehicle
        error = target - state.position
        bound = g.max_integral
        wanted = _shorten(g.position * error, g.max_speed)
        slip = _shorten(wanted - state.velocity, g.max_slip)
        integral = integral + g.integral * slip * dt
        integral = integral.clamp(-bound, bound)
        pull = g.velocity * (wanted - state.velocity) + integral
        pull = pull - pull.new_tensor([0.0, 0.0, GRAVITY])  # specific force, up is negative
        up = (-pull[:, 2:]).clamp(min=0.2 * GRAVITY)
        across = _shorten(pull[:, :2], 1.0, up * math.tan(g.max_tilt))
        force = torch.cat([across, -up], dim=-1)

        rotation = state.rotation
        wanted_rotation = _level_with(-force, yaw)
        between = wanted_rotation.transpose(-1, -2) @ rotation
        lean = 0.5 * (between - between.transpose(-1, -2))  # zero for equal attitudes
        angle = torch.stack([lean[:, 2, 1], lean[:, 0, 2], lean[:, 1, 0]], dim=-1)
        spin = g.rate * (-g.attitude * angle - state.body_rates)
        momentum = state.body_rates @ vehicle.inertia
        torque = spin @ vehicle.inertia + torch.linalg.cross(state.body_rates, momentum)
        lift = vehicle.mass * (force[:, None] @ rotation[..., 2:])[:, :, 0]  # along body z
        thrusts = torch.cat([lift, torque], dim=-1) @ self._mixer.T
        return torch.minimum(thrusts.clamp(min=0.0), vehicle.max_thrusts), integral


def _shorten(vector: Tensor, limit: float, scale: Tensor | None = None) -> Tensor:
    """The vector, no longer than limit (times scale)."""
    bound = vector.new_full((), limit) if scale is None else limit * scale
    square = vector.square().sum(dim=-1, keepdim=True)
    return vector * (bound / torch.sqrt(square.clamp(min=1e-24))).clamp(max=1.0)


def _level_with(down: Tensor, yaw: Tensor) -> Tensor:
    """World from body, z axis along ``down``, heading ``yaw``, (batch, 3, 3)."""
    z = torch.nn.functional.normalize(down, dim=-1)
    heading = torch.stack([torch.cos(yaw), torch.sin(yaw), torch.zeros_like(yaw)], dim=-1)
    y = torch.nn.functional.normalize(torch.linalg.cross(z, heading), dim=-1)
    return torch.stack([torch.linalg.cross(y, z), y, z], dim=-1)
