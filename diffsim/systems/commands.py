"""Commands of a run as tensors: recorded numbers, or what carries gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.data.study import Run


def command_of(run: Run, name: str) -> Tensor:
    """A command of a run, (num_samples,) float64. Gradient: the command, where it is a tensor.

    Raises:
        ValueError: the run has no such command; the message offers the closest names.
    """
    require_choice(f"run {run.name}: command", name, run.command)
    given: Any = run.command[name]
    if isinstance(given, Tensor):
        return given.double()
    return torch.from_numpy(np.ascontiguousarray(given, dtype=np.float64))


def interpolated(at: Tensor, places: Any, values: Any) -> Tensor:
    """Straight lines between points, held beyond the ends, as ``numpy.interp`` has it.

    Args:
        at: Where values are wanted, any shape.
        places: Increasing, (num_points,).
        values: (num_points,).

    Returns:
        Shape of ``at``. Gradient: at, values, where they are tensors.
    """
    if not any(isinstance(v, Tensor) and v.requires_grad for v in (at, values)):
        found = np.interp(at.numpy(), np.asarray(places), np.asarray(values))
        return torch.from_numpy(np.asarray(found))
    x, y = (torch.as_tensor(v, dtype=torch.float64) for v in (places, values))
    right = torch.searchsorted(x, at.detach(), right=True).clamp(1, len(x) - 1)
    left, inside = right - 1, torch.maximum(torch.minimum(at, x[-1]), x[0])
    return y[left] + (inside - x[left]) / (x[right] - x[left]) * (y[right] - y[left])
