"""Paths that a copter may be asked to follow next: states of 12 over time, north-east-down."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import torch
from torch import Tensor

Path = Callable[[Tensor], Tensor]
"""States (num_samples, 12) at times (num_samples,) [s]."""


def rise(t: Tensor) -> Tensor:
    """From 0 to 1 within 2 s and back, smoothly."""
    return 0.5 - 0.5 * torch.cos(0.5 * torch.pi * t)


def path(
    t: Tensor,
    north: Tensor | float = 0.0,
    east: Tensor | float = 0.0,
    height: Tensor | float = 1.0,
    yaw: Tensor | float = 0.0,
) -> Tensor:
    """States of 12 to be followed, (num_samples, 12).

    Args:
        t: Times, (num_samples,) [s].
        north, east, height: Places [m].
        yaw: Heading [rad].
    """
    aim = torch.zeros(len(t), 12, dtype=torch.float64)
    aim[:, 0], aim[:, 1], aim[:, 5] = north, east, yaw
    aim[:, 2] = -torch.as_tensor(height, dtype=torch.float64)
    return aim


PATHS: Mapping[str, Path] = MappingProxyType(
    {
        "hover": path,
        "low_hover": lambda t: path(t, height=0.2),
        "fast_forward": lambda t: path(t, north=4.0 * rise(t)),
        "climb": lambda t: path(t, height=0.5 + 3.0 * rise(t)),
        "weave": lambda t: path(t, east=0.4 * torch.sin(3.0 * t)),
        "turn": lambda t: path(t, yaw=1.5 * rise(t)),
    }
)
"""Six that tell causes apart."""
