"""Causes that a multicopter carries or meets: a load on a string, a gust."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.data.study import Run
from diffsim.systems.multicopter.motion import FlightMotion
from diffsim.systems.multicopter.scene import CopterScene, amount

SLING_M = 0.5  # of a string whose length nobody stated


def hang_load(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """A point mass on a string below the center of mass, at rest when the record starts.

    For small swings d of the load, d'' = -g / l d - a with the recorded acceleration a of the
    vehicle; the string pulls with m g / l d to the side and with m (g - a_z) downwards.
    """
    mass, dt = amount(size, 2), scene.dt
    length = scene.numbers.get("sling_length", torch.full_like(mass, SLING_M))
    stiffness = GRAVITY / length.reshape(-1, 1, 1)
    swing = _swing_pendulum(scene.windows.acceleration, dt, stiffness.sqrt())
    sideways = mass * stiffness * swing * swing.new_tensor([1.0, 1.0, 0.0])

    def weight(motion: FlightMotion) -> Tensor:
        down = motion.acceleration.new_tensor([0.0, 0.0, 1.0])
        return amount(size, 3) * (GRAVITY - motion.acceleration) * down

    return scene.changed(world_force=scene.world_force + sideways).with_air(weight)


def _swing_pendulum(acceleration: Tensor, dt: float, rate: Tensor) -> Tensor:
    """Swing of a pendulum in the middle of every step, (points, num_samples, 3) [m].

    Exact for accelerations that are held over steps; a convolution, by Fourier transforms.

    Args:
        acceleration: Of the point of suspension at every sample, (num_samples, 3) [m/s^2].
        dt: Time between two samples [s].
        rate: Natural rate of the pendulum, (points, 1, 1) [rad/s].
    """
    held = torch.cat([0.5 * (acceleration[1:] + acceleration[:-1]), acceleration[-1:]])
    count = len(held)
    n = torch.arange(count, dtype=torch.float64)[:, None]
    kernel = torch.cos(rate * (n - 0.5).clamp(min=0.0) * dt) - torch.cos(rate * (n + 0.5) * dt)
    size = 2 * count
    product = torch.fft.rfft(kernel, size, 1) * torch.fft.rfft(held, size, 0)
    return -torch.fft.irfft(product, size, 1)[:, :count] / rate**2


def push_in_gusts(scene: CopterScene, size: Tensor, run: Run) -> CopterScene:
    """Force in the world along x and y: sines and cosines of 2 pi f t, t the recording's clock."""
    middle = torch.as_tensor(run.time_s, dtype=torch.float64) + 0.5 * scene.dt
    angle = 2.0 * torch.pi * scene.number("gust_frequency").reshape(-1, 1) * middle
    parts = size.reshape(-1, 4)[:, None]
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    across = parts[..., 0::2] * sine + parts[..., 1::2] * cosine
    force = torch.nn.functional.pad(across, (0, 1))
    return scene.changed(world_force=scene.world_force + scene.frames.in_world(force))
