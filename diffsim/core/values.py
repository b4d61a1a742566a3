"""Numbers and vectors at the boundary: checked, turned into tensors, their gradients kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import LARGEST, require, require_number, require_range
from diffsim.core.numbers import values_of

Number = float | Tensor
Vector = Sequence[float] | Tensor


# Kinds of NumPy's dtypes that each of ours takes, and their name in messages.
_KINDS = {
    torch.float64: ("iuf", "numbers"),
    torch.int64: ("iu", "whole numbers"),
    torch.bool: ("b", "True or False"),
}


def joined(value: Any) -> Any:
    """A list with tensors in it as one tensor, since torch drops their gradients; others stay."""
    if not isinstance(value, (list, tuple)):
        return value
    parts = [joined(part) for part in value]
    if not any(isinstance(part, Tensor) for part in parts):
        return value
    return torch.stack([torch.as_tensor(part, dtype=torch.float64) for part in parts])


def scalar(name: str, value: Number, *, hint: str = "", **limits: float) -> Tensor:
    """A finite number or () tensor within limits as a float64 tensor; gradients are kept."""
    if isinstance(value, Tensor):
        return _not_huge(name, require_range(name, require(name, value, ()), hint=hint, **limits))
    number = require_number(name, value, hint=hint, **limits)
    return _not_huge(name, torch.tensor(number, dtype=torch.float64))


def _not_huge(name: str, value: Tensor) -> Tensor:
    """Refuse numbers whose squares are none; in a graph all pass."""
    if torch.compiler.is_compiling():
        return value
    return require_range(name, value, at_least=-LARGEST, at_most=LARGEST)


def amounts(name: str, value: Number, *, hint: str = "", **limits: float) -> Tensor:
    """Finite numbers within limits, one or a tensor of any shape, as a float64 tensor; gradients
    are kept."""
    given = require(name, as_array(name, value), ("...",))
    if limits and not torch.compiler.is_compiling():
        require_range(name, given, hint=hint, **limits)
    return given


def vector(name: str, value: Vector) -> Tensor:
    """Three finite numbers or a (3,) tensor as a float64 tensor; gradients are kept."""
    if isinstance(value := joined(value), Tensor):
        return _not_huge(name, require(name, value, (3,)))
    try:
        v = torch.tensor([float(number) for number in value], dtype=torch.float64)
    except (TypeError, ValueError):
        v = torch.empty(0, dtype=torch.float64)
    if v.shape != (3,) or not bool(torch.isfinite(v).all()):
        raise ValueError(f"{name} must be three finite numbers, got {value!r}")
    return _not_huge(name, v)


def as_array(name: str, value: Any, dtype: torch.dtype = torch.float64) -> Tensor:
    """Numbers in lists, arrays or a tensor as a tensor; a tensor stays, with its gradient.

    For arguments that are given once. What is given step by step must be a tensor: there, a
    conversion would be paid at every step.

    Args:
        name: The argument's name, for the message.
        dtype: Dtype of the tensor; entries of another kind are refused, not rounded.

    Raises:
        TypeError: no numbers, rows of different lengths, entries of another kind, or a list with
            tensors in it.
    """
    if isinstance(value, Tensor):
        return value
    if isinstance(value, (list, tuple)) and any(isinstance(entry, Tensor) for entry in value):
        raise TypeError(
            f"{name} must be an array of numbers, got a list with tensors in it; join them with "
            f"torch.stack({name})"
        )
    kinds, what = _KINDS[dtype]
    try:
        given = np.asarray(value)
        if given.size and given.dtype.kind not in kinds:
            raise TypeError(f"entries are of type {given.dtype}, not {what}")
        return torch.tensor(given.astype(given.dtype.newbyteorder("=")), dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        shown = repr(value) if len(repr(value)) < 80 else f"{repr(value)[:80]}..."
        raise TypeError(f"{name} must be an array of numbers, got {shown}: {error}") from None


def friction_coefficient(value: Number) -> Tensor:
    """A coefficient >= 0, () or (batch,); ``math.inf`` means that touching nodes stick."""
    if isinstance(value, Tensor):
        mu = require("friction", value, ("batch",) if value.ndim else (), finite=False)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        mu = torch.tensor(float(value), dtype=torch.float64)
    else:
        raise TypeError(f"friction must be a number, got {type(value).__name__}")
    numbers = values_of(mu)
    bad = numbers[~(numbers >= 0.0)]  # NaN is not
    if len(bad):
        raise ValueError(
            f"friction must lie in [0, inf], got {float(bad[0]):g}; "
            "0 slides freely, math.inf sticks"
        )
    return mu


def direction(v: Tensor, fallback: Tensor, tiny: float | Tensor = 1e-150) -> tuple[Tensor, Tensor]:
    """Length and unit vector of v (..., 3); where shorter than ``tiny``: 0 and ``fallback``.

    There, both are constants: their gradients are zero, never NaN.
    """
    short = (v.detach().abs().amax(-1, keepdim=True)) <= tiny
    safe = torch.where(short, fallback, v)
    length = safe.norm(dim=-1, keepdim=True)
    return torch.where(short, 0.0, length)[..., 0], safe / length


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product over the last axis."""
    return (a * b).sum(-1)
