"""Where a multicopter is and how it moves: the rigid body's state, and the minimal one of 12.

And all arguments of a flight as rows of numbers, in the order in which the kernel reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.dynamics import _ops_flight
from diffsim.copter.vehicle.effects import FlightEffects
from diffsim.copter.vehicle.multicopter import Fleet, Multicopter
from diffsim.core.check import all_finite, require, require_shape
from diffsim.core.checked import checked
from diffsim.core.module import loadable
from diffsim.core.numbers import values_of
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


_NEUTRAL = {"curve_reference": 1.0, "nominal_voltage": 1.0}  # the others are zero where absent


def fleet_of(vehicle: Multicopter | Sequence[Multicopter]) -> Fleet:
    """Vehicles of equal rotor count, as many as the kernel takes, stacked."""
    vehicles = [vehicle] if isinstance(vehicle, Multicopter) else list(vehicle)
    counts = sorted({v.num_rotors for v in vehicles})
    if len(counts) != 1:
        raise ValueError(f"vehicles of one flight need equal rotor counts, got {counts}")
    if counts[0] > _ops_flight.MAX_ROTORS:
        raise ValueError(f"flights take up to {_ops_flight.MAX_ROTORS} rotors, got {counts[0]}")
    return Fleet.of(vehicles)


def common_size(what: str, sizes: dict[str, int]) -> int:
    """The size that all share but for those that are one (or absent: zero)."""
    many = {name: size for name, size in sizes.items() if size > 1}
    if len(set(many.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in many.items())
        raise ValueError(f"{what} sizes disagree: {listed}; each must be one of them or 1")
    return max([1, *many.values()])


def with_batch_and_steps(value: Tensor) -> Tensor:
    """(width,), (steps, width) or (batch, steps, width) as the last."""
    return value.reshape((1,) * (3 - value.dim()) + value.shape)


def start_rows(start: FlightState, commands: Tensor) -> Tensor:
    """Rows of the kernel's starts, (batch or 1, 1, size)."""
    norm = torch.linalg.vector_norm(start.quaternion, dim=-1, keepdim=True)
    if not torch.compiler.is_compiling() and float(values_of(norm).min()) < 1e-6:
        raise ValueError("start.quaternion must not be zero; (1, 0, 0, 0) is level, heading north")
    if commands.shape[1] == 0 and start.thrusts is None:
        raise ValueError("commands has no steps; give at least one, or start.thrusts")
    parts = {
        "position": start.position,
        "quaternion": start.quaternion / norm,
        "velocity": start.velocity,
        "body_rates": start.body_rates,
        "charge": torch.ones_like(norm) if start.charge is None else start.charge[:, None],
        "thrusts": commands[:, 0] if start.thrusts is None else start.thrusts,
    }
    sizes = {"start": start.position.shape[0], "commands": parts["thrusts"].shape[0]}
    if 0 in sizes.values():
        raise ValueError(f"start and commands must have at least one flight, got {sizes}")
    batch = common_size("batch", sizes)
    fitted = [p if p.shape[0] == batch else p.expand(batch, -1) for p in parts.values()]
    row = torch.cat(fitted, dim=-1)
    if not torch.compiler.is_compiling() and not all_finite(values_of(row)):
        for name, part in parts.items():
            require(f"start.{name}", part, ("...", part.shape[-1]))
    return row[:, None]


def parameter_rows(fleet: Fleet, effects: FlightEffects, dt: float) -> Tensor:
    """Rows of the kernel's parameters, (batch or 1, 1, size)."""
    n = fleet.num_rotors
    values = fleet.rows()
    for _, effect in effects.present():
        values |= effect.row(dt)
    pieces = []
    for name, size in _ops_flight.fields(n):
        value = values.get(name)
        if value is None:
            value = torch.full((1, size), _NEUTRAL.get(name, 0.0), dtype=torch.float64)
        if not value.numel() or value.numel() % size:
            raise ValueError(f"{name} needs {size} values per vehicle, got {tuple(value.shape)}")
        pieces.append(value.reshape(-1, size))
    batch = common_size(
        "vehicle and effects",
        {
            name: piece.shape[0]
            for (name, _), piece in zip(_ops_flight.fields(n), pieces, strict=True)
        },
    )
    return torch.cat([piece.expand(batch, -1) for piece in pieces], dim=-1)[:, None]
