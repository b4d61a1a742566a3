"""Lags of a flight: of the rotors' speed, and of readings in windows."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.causes.signals import SHORTEST_LAG, Grid, affine_scan, decayed


def speed_lagged(thrusts: Tensor, grid: Grid, time_constant: Tensor) -> Tensor:
    """First-order lag of the rotors' speed, thrust ~ speed^2: mean over the step.

    With w the root of the commanded thrust and e = y - w the lagged root's error at the step's
    start, the root is w + e exp(-t / tau); the mean of its square over the step is exact.

    Args:
        thrusts: Commanded thrusts, held until the next sample, (..., n_rotors, num_times) [N].
        time_constant: tau, (..., 1) [s]; at first the rotors turn as commanded.
    """
    dt, tau = float(grid.times[1] - grid.times[0]), time_constant
    root = thrusts.clamp(min=1e-9).sqrt()  # [N]: the root has no slope at zero
    decay = torch.exp(-dt / tau.clamp(min=SHORTEST_LAG * dt))
    share = tau / dt
    once, twice = share * (1.0 - decay), 0.5 * share * (1.0 - decay**2)
    later = decayed(decay, -root.diff(dim=-1))
    error = torch.cat([torch.zeros_like(later[..., :1]), later], -1)
    return thrusts + 2.0 * root * error * once[..., None] + error**2 * twice[..., None]


def lagged_in_windows(y: Tensor, grid: Grid, time_constant: Tensor) -> Tensor:
    """First-order lag of readings in windows, each of which it enters in a steady slope.

    Args:
        y: Readings, (num_windows, points, width, length).
        time_constant: tau, (..., 1) [s].
    """
    if y.shape[-1] < 2:
        return y
    dt, tau = float(grid.times[1] - grid.times[0]), time_constant[..., None]
    decay = torch.exp(-dt / tau.clamp(min=SHORTEST_LAG * dt))
    target = tau * y.diff(dim=-1) / dt
    begun = target[..., :1]
    # e = y - y': e' = y' - e / tau, from one time to the next target + (e - target) * decay
    driven = affine_scan(decay.expand_as(target), target * (1.0 - decay))
    powers = decay ** torch.arange(1, y.shape[-1], dtype=y.dtype)
    return y - torch.cat([begun, driven + begun * powers], -1)
