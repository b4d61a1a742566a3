"""Commands that come late in an environment, kept in a queue."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def queue_length(delay: float, dt: float) -> int:
    """Commands to be kept for a delay [s] with steps of dt [s]."""
    return int(np.ceil(delay / dt - 1e-9)) + 1


def delayed(queue: Tensor, asked: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
    """What acts over a step, in the mean, when commands come late; and the commands kept.

    Args:
        queue: Commands of the steps before, the oldest first, (batch, length, width).
        asked: Command of this step, (batch, width).
        steps: Delay in steps, at most length, (batch or 1,).
    """
    kept = torch.cat([queue, asked[:, None]], 1)
    ages = torch.arange(kept.shape[1] - 1, -1, -1, dtype=steps.dtype)
    # a command held over its step and late by 2.3 steps: 0.7 of that two steps ago, 0.3 of three
    shares = (1.0 - (ages - steps[:, None]).abs()).clamp(min=0.0)
    return (shares[..., None] * kept).sum(1), kept[:, 1:]
