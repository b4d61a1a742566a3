"""Values as lines of text with all digits, and what the reference results are weighed with."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Value = Any
MAX_LISTED = 12
"""Arrays of more numbers are shown as shape, norm and hash."""


def lines_of(name: str, value: Value) -> Iterator[str]:
    """Lines ``name = value`` that are equal only if every bit is.

    Args:
        name: Left of the equals sign; parts of ``value`` add ``/part``.
        value: Number, text, None, array, tensor, sequence, or a mapping of these by name.

    Returns:
        One line per number, text or array; of a long array shape, norm (of what is a number) and
        SHA-256 of its float64 or int64 bytes.

    Raises:
        TypeError: a value of another kind.
    """
    if isinstance(value, Mapping):
        for part, inner in value.items():
            yield from lines_of(f"{name}/{part}", inner)
    elif value is None or isinstance(value, str | bool | np.bool_):
        yield f"{name} = {bool(value) if isinstance(value, np.bool_) else value!r}"
    elif isinstance(value, Integral):
        yield f"{name} = {int(value)}"
    elif isinstance(value, Real):
        yield f"{name} = {float(value)!r}"
    elif isinstance(value, Tensor):
        yield from _array_lines(name, value.detach().numpy())
    elif isinstance(value, np.ndarray):
        yield from _array_lines(name, value)
    elif isinstance(value, Sequence) and all(isinstance(v, str) for v in value):
        yield f"{name} = {list(value)!r}"
    elif isinstance(value, Sequence) and any(isinstance(v, str) for v in value):
        for place, inner in enumerate(value):  # a number and its name, say
            yield from lines_of(f"{name}/{place}", inner)
    elif isinstance(value, Sequence):
        yield from _array_lines(name, np.array(value))
    else:
        raise TypeError(f"{name} must be numbers, text or a mapping, got {type(value).__name__}")


def _array_lines(name: str, array: NDArray[Any]) -> Iterator[str]:
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{name} must hold numbers, got an array of {array.dtype}")
    if array.ndim == 0:
        yield from lines_of(name, array.item())
        return
    array = np.array(array, np.float64 if array.dtype.kind == "f" else np.int64, order="C")
    if array.size <= MAX_LISTED:
        yield f"{name} = {array.tolist()!r}"
        return
    missing = np.isnan(array)
    # Exactly rounded, so that the order of summation does not matter.
    norm = math.sqrt(math.fsum(float(v) * float(v) for v in array[~missing]))
    if missing.any():
        array[missing] = np.nan  # which has many bit patterns
    digest = hashlib.sha256(array.tobytes()).hexdigest()
    yield f"{name} = shape {list(array.shape)}, norm {norm!r}, sha256 {digest}"


def leaf(value: Any) -> Tensor:
    """A float64 tensor of its own that asks for its gradient."""
    return torch.as_tensor(value, dtype=torch.float64).detach().clone().requires_grad_()


def weighted_sum(*tensors: Tensor) -> Tensor:
    """Sum of all entries with weights from 1 to 2: no entry's gradient is that of another."""
    flat = torch.cat([t.reshape(-1) for t in tensors])
    return (flat * torch.linspace(1.0, 2.0, len(flat), dtype=flat.dtype)).sum()


def gradients(loss: Tensor, **leaves: Tensor) -> dict[str, Any]:
    """The loss, and its gradient in every leaf by the leaf's name."""
    found = torch.autograd.grad(loss, list(leaves.values()), retain_graph=True)
    return {"loss": loss, "gradient": dict(zip(leaves, found, strict=True))}
