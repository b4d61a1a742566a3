"""The motion of a multicopter in the middle of every control step, on which causes may depend."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from diffsim.copter.fleet import Fleet


@dataclass(frozen=True, eq=False)
class Motion:
    """State in the middle of every control step, which causes may depend on.

    Attributes:
        vehicle: Vehicle that flies.
        position: World frame, (points, num_windows, length, 3) [m].
        velocity: World frame, of the same shape [m/s].
        rotation: World from body, (points, num_windows, length, 3, 3).
        body_rates: Angular velocity in the body frame, (points, num_windows, length, 3) [rad/s].
        thrusts: Over the step, (points, num_windows, length, n_rotors) [N]; what causes gave to
            the vehicle through them is in them.
        asked: Thrusts that were asked for, of the same shape [N]: the rotors' speeds.
        acceleration: Mean over the step, world frame, (points, num_windows, length, 3) [m/s^2].
    """

    vehicle: Fleet
    position: Tensor
    velocity: Tensor
    rotation: Tensor
    body_rates: Tensor
    thrusts: Tensor
    asked: Tensor
    acceleration: Tensor

    @property
    def body_velocity(self) -> Tensor:
        """(points, num_windows, length, 3) [m/s]."""
        return turned_back(self.rotation, self.velocity)


def turned_back(rotation: Tensor, value: Tensor) -> Tensor:
    """R' v without a product of many small matrices, which is slow."""
    return (rotation * value[..., None]).sum(-2)


def by_rotor(vectors: Tensor, rotors: Tensor) -> Tensor:
    """Products of vectors (points, windows, length, k) with rows (points, n_rotors, k)."""
    return vectors @ rotors.mT[:, None]
