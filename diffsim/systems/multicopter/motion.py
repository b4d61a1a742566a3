"""The motion of a multicopter in the middle of every control step, on which causes may depend."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import Fleet


@dataclass(frozen=True, eq=False)
class FlightMotion:
    """State in the middle of every control step, which causes may depend on."""

    vehicle: Fleet  # vehicle that flies
    position: Tensor  # world frame, (points, num_windows, length, 3) [m]
    velocity: Tensor  # world frame, of the same shape [m/s]
    rotation: Tensor  # world from body, (points, num_windows, length, 3, 3)
    # angular velocity in the body frame, (points, num_windows, length, 3) [rad/s]
    body_rates: Tensor
    # over the step, (points, num_windows, length, n_rotors) [N]; what causes gave to the vehicle
    # through them is in them
    thrusts: Tensor
    asked: Tensor  # thrusts that were asked for, of the same shape [N]: the rotors' speeds
    # mean over the step, world frame, (points, num_windows, length, 3) [m/s^2]
    acceleration: Tensor

    @cached_property
    def body_velocity(self) -> Tensor:
        """(points, num_windows, length, 3) [m/s]."""
        return turned_back(self.rotation, self.velocity)

    def rotor_speeds(self, thrust_coefficient: float | Tensor) -> Tensor:
        """sqrt(thrust asked for / thrust coefficient), (points, num_windows, length, n_rotors)
        [rad/s]; the root has no slope at zero."""
        return (self.asked.clamp(min=1e-9) / thrust_coefficient).sqrt()


def turned_back(rotation: Tensor, value: Tensor) -> Tensor:
    """R' v without a product of many small matrices, or a sum along a short axis: both are slow."""
    (x, y, z), (a, b, c) = rotation.unbind(-2), value[..., None].unbind(-2)
    return x * a + y * b + z * c


def turned(rotation: Tensor, value: Tensor) -> Tensor:
    """R v, likewise."""
    return turned_back(rotation.mT, value)


def by_rotor(vectors: Tensor, rotors: Tensor) -> Tensor:
    """Products of vectors (points, windows, length, k) with rows (points, n_rotors, k)."""
    lead = np.broadcast_shapes(vectors.shape[:1], rotors.shape[:1])
    rows = vectors.expand(*lead, *vectors.shape[1:]).flatten(1, -2)
    return (rows @ rotors.mT).unflatten(1, vectors.shape[1:-1])


def stack_points(numbers: Iterable[Tensor]) -> Tensor:
    """Some numbers, () or (points,) each, beside each other, (points, number of them)."""
    return torch.stack(torch.broadcast_tensors(*(n.reshape(-1) for n in numbers)), -1)


def vector_of(values: Mapping[str, Tensor], name: str) -> Tensor:
    """(points, 3) of the numbers name_x, name_y, name_z; 0 where there are none."""
    zero = torch.zeros(1, dtype=torch.float64)
    return stack_points(values.get(f"{name}_{axis}", zero) for axis in "xyz")
