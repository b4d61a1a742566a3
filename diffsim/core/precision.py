"""Simulators for callers of another precision or device: float64 on the CPU inside."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor


def in_float64(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that takes tensors of any precision and device and computes in float64 on the CPU.

    Tensors among the arguments, also within tuples, lists and dicts, are copied to the CPU, and
    those of floating numbers to float64. What the function returns comes back in the precision and
    on the device of the arguments' floating tensors; so do gradients, in reverse and in forward
    mode. Records of tensors, such as ``soft.State``, pass as they are: a state that goes from step
    to step is not rounded on its way.

    Args:
        function: Of tensors and anything else, such as ``task.step``.

    Returns:
        A function of the same arguments. It raises TypeError where floating tensors among them are
        of more than one precision or device.
    """

    @functools.wraps(function)
    def called(*args: Any, **named: Any) -> Any:
        outside = _precision_of([args, named])
        args, named = _convert((args, named), torch.float64, torch.device("cpu"))
        result = function(*args, **named)
        return result if outside is None else _convert(result, *outside)

    return called


def _tensors(value: Any) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif type(value) is dict:
        yield from _tensors(list(value.values()))
    elif type(value) in (tuple, list):
        for part in value:
            yield from _tensors(part)


def _convert(value: Any, dtype: torch.dtype, device: torch.device) -> Any:
    if isinstance(value, Tensor):
        return value.to(device, dtype if value.is_floating_point() else value.dtype)
    if type(value) is dict:
        return {key: _convert(part, dtype, device) for key, part in value.items()}
    if type(value) in (tuple, list):
        return type(value)(_convert(part, dtype, device) for part in value)
    return value


def _precision_of(arguments: Any) -> tuple[torch.dtype, torch.device] | None:
    """What the floating tensors among the arguments share; None where there are none."""
    found = {(t.dtype, t.device): None for t in _tensors(arguments) if t.is_floating_point()}
    if len(found) > 1:
        kinds = ", ".join(f"{dtype} on {device}" for dtype, device in found)
        raise TypeError(
            f"tensors must share one precision and device, got {kinds}; convert with "
            "x.to(other), which converts to both of another tensor"
        )
    return next(iter(found), None)
