"""Physical parameters of modules: numbers, tensors or ``nn.Parameter``, all in float64."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from diffsim.core.values import joined

Value = float | Sequence[float] | Tensor | nn.Parameter


def as_tensor(name: str, value: Value) -> Tensor:
    """A tensor as it is (with its gradient), numbers as float64."""
    if isinstance(value := joined(value), Tensor):
        return value
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as err:
        raise TypeError(
            f"{name} must be a number, a sequence of numbers or a torch.Tensor, got "
            f"{type(value).__name__}"
        ) from err


def hold(module: nn.Module, name: str, value: Value | None) -> None:
    """Make ``value`` an attribute of a module: an ``nn.Parameter`` as such, all else a buffer."""
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, None if value is None else as_tensor(name, value))
