"""What noisy sensors of a multicopter read along a flight."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.dynamics.flight_state import FlightState
from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.check import require, require_number


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """White noise of every reading and constant biases of gyro and accelerometer.

    Attributes:
        gyro: Standard deviation of a reading [rad/s].
        gyro_bias: Standard deviation of the bias, drawn once per vehicle and axis [rad/s].
        accelerometer: Noise of the accelerometer, sd [m/s^2].
        accelerometer_bias: Bias of the accelerometer, sd [m/s^2].
        position: Noise of the position, sd [m].
    """

    gyro: float = 0.003
    gyro_bias: float = 0.005
    accelerometer: float = 0.05
    accelerometer_bias: float = 0.05
    position: float = 0.02

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require_number(name, value, at_least=0.0)


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """Readings with the leading axes of the states, (batch, time).

    Attributes:
        gyro: Angular velocity in the body frame, (batch, time, 3) [rad/s].
        accelerometer: Specific force (acceleration less gravity) in the body frame,
            (batch, time, 3) [m/s^2]; (0, 0, -9.81) at rest.
        position: World frame, (batch, time, 3) [m].
    """

    gyro: Tensor
    accelerometer: Tensor
    position: Tensor


def read_sensors(
    state: FlightState, acceleration: Tensor, *, seed: int, noise: SensorNoise | None = None
) -> SensorReadings:
    """Noisy readings; differentiable in the state, equal for equal seeds.

    Args:
        state: Leading axes (batch, time), as a flight has them.
        acceleration: Acceleration of the center of mass, world frame, (batch, time, 3) [m/s^2]; of
            a flight: ``finite_acceleration``.
        seed: Seed of the noise.
        noise: ``SensorNoise()`` by default.
    """
    noise = SensorNoise() if noise is None else noise
    batch, time = state.position.shape[:2]
    require("acceleration", acceleration, (batch, time, 3))
    generator = torch.Generator().manual_seed(seed)

    def normal(scale: float, *shape: int) -> Tensor:
        return scale * torch.randn(*shape, generator=generator, dtype=torch.float64)

    def disturbed(value: Tensor, white: float, bias: float) -> Tensor:
        return value + normal(bias, batch, 1, 3) + normal(white, batch, time, 3)

    gravity = acceleration.new_tensor([0.0, 0.0, GRAVITY])
    specific = state.rotation.transpose(-1, -2) @ (acceleration - gravity)[..., None]
    return SensorReadings(
        gyro=disturbed(state.body_rates, noise.gyro, noise.gyro_bias),
        accelerometer=disturbed(specific[..., 0], noise.accelerometer, noise.accelerometer_bias),
        position=disturbed(state.position, noise.position, 0.0),
    )


def finite_acceleration(velocity: Tensor, dt: float) -> Tensor:
    """Mean acceleration over the step that ends at each time (over the first step at its start).

    Args:
        velocity: World frame, (batch, time, 3) [m/s], two times or more.
        dt: Between the times [s].

    Returns:
        (batch, time, 3) [m/s^2].
    """
    if velocity.shape[-2] < 2:
        raise ValueError(f"velocity needs two times or more, got {velocity.shape[-2]}")
    mean = velocity.diff(dim=-2) / dt
    return torch.cat([mean[:, :1], mean], dim=-2)
