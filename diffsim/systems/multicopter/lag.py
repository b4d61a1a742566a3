"""Motors whose speed, not their thrust, follows the command with a lag."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.causes.signals import decayed

_LEAST_N = 1e-9  # of a thrust: the root has no slope at zero
_SHORTEST = 1e-3  # of a step: below it exp(-dt / tau) is zero to the last digit


def speed_lagged(thrusts: Tensor, dt: float, time_constant: Tensor) -> Tensor:
    """First-order lag of the rotors' speed, thrust ~ speed^2: mean over the step.

    With w the root of the commanded thrust and e = y - w the lagged root's error at the step's
    start, the root is w + e exp(-t / tau); the mean of its square over the step is exact.

    Args:
        thrusts: Commanded thrusts, held until the next sample, (points, num_samples, n_rotors) [N].
        dt: Time between two samples [s].
        time_constant: tau, () or (points,) [s]; at first the rotors turn as commanded.
    """
    root = thrusts.clamp(min=_LEAST_N).sqrt()
    decay = torch.exp(-dt / time_constant.clamp(min=_SHORTEST * dt))[..., None]
    share = (time_constant / dt)[..., None]
    once, twice = share * (1.0 - decay), 0.5 * share * (1.0 - decay**2)
    later = decayed(decay, -root.diff(dim=-2).mT).mT
    error = torch.cat([torch.zeros_like(later[..., :1, :]), later], -2)
    return thrusts + 2.0 * root * error * once[..., None] + error**2 * twice[..., None]
