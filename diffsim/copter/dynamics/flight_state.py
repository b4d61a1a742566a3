"""Where a multicopter is and how it moves: the rigid body's state, and the minimal one of 12."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import require, require_shape
from diffsim.core.checked import checked
from diffsim.core.module import loadable
from diffsim.core.rotation import (
    body_rates_from_rpy_rates,
    matrix_from_quaternion,
    quaternion_from_rpy,
    rpy_from_matrix,
    rpy_rates_from_body_rates,
)


@loadable
@dataclass(frozen=True, eq=False)
class FlightState:
    """State of a batch of vehicles, NED; leading axes are (batch,) or, for a flight, (batch, time).

    Attributes:
        position: Position of the center of mass, (..., 3) [m].
        quaternion: World from body, (w, x, y, z), (..., 4); normalized when a flight starts.
        velocity: World frame, (..., 3) [m/s].
        body_rates: Angular velocity in the body frame, (..., 3) [rad/s].
        thrusts: State of the motors, (..., n_rotors) [N]; None: settled at the first command.
        charge: State of charge of the battery, 0 to 1, (...); None: full.
    """

    position: Tensor
    quaternion: Tensor
    velocity: Tensor
    body_rates: Tensor
    thrusts: Tensor | None = None
    charge: Tensor | None = None

    def __post_init__(self) -> None:
        # kept as given: a flight's fields are strided views of its records, and a copy made only to
        # be looked at cost up to half of the flight
        require_shape("position", self.position, ("...", 3))
        lead = self.position.shape[:-1]
        for name, width in (("quaternion", 4), ("velocity", 3), ("body_rates", 3)):
            require_shape(name, getattr(self, name), (*lead, width))
        if self.thrusts is not None:
            require_shape("thrusts", self.thrusts, (*lead, "n_rotors"))
        if self.charge is not None:
            require_shape("charge", self.charge, tuple(lead))

    @classmethod
    @checked(position=("...", 3), rpy=("...", 3))
    def at_rest(cls, position: Tensor, rpy: Tensor | None = None) -> FlightState:
        """Standing still.

        Args:
            position: Position, (..., 3) [m].
            rpy: Roll, pitch, yaw, (..., 3) [rad]; zero by default.
        """
        rpy = torch.zeros_like(position) if rpy is None else rpy
        require("rpy", rpy, tuple(position.shape))
        still = torch.zeros_like(position)
        return cls(position, quaternion_from_rpy(rpy), still, still)

    @classmethod
    def from_minimal(cls, x12: Tensor) -> FlightState:
        """From the state of 12 of a linear controller.

        Args:
            x12: Position, roll-pitch-yaw, velocity in the body frame, rates of roll, pitch and yaw,
                (..., 12) [m, rad, m/s, rad/s].
        """
        require("x12", x12, ("...", 12))
        position, rpy, velocity, rates = x12.split(3, dim=-1)
        quaternion = quaternion_from_rpy(rpy)
        world = (matrix_from_quaternion(quaternion) @ velocity[..., None])[..., 0]
        return cls(position, quaternion, world, body_rates_from_rpy_rates(rpy, rates))

    @property
    def rotation(self) -> Tensor:
        """World from body, (..., 3, 3)."""
        return matrix_from_quaternion(self.quaternion)

    @property
    def rpy(self) -> Tensor:
        """Roll, pitch, yaw, (..., 3) [rad]."""
        return rpy_from_matrix(self.rotation)

    def minimal(self) -> Tensor:
        """The state of 12 (see ``from_minimal``), (..., 12)."""
        rotation, rpy = self.rotation, self.rpy
        velocity = (rotation.transpose(-1, -2) @ self.velocity[..., None])[..., 0]
        rates = rpy_rates_from_body_rates(rpy, self.body_rates)
        return torch.cat([self.position, rpy, velocity, rates], dim=-1)
