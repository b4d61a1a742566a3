"""The numbers behind tensors, where ``torch.func`` wraps them too."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from diffsim.core.torch_names import (
    is_batched,
    is_in_func,
    is_recorded,
    is_wrapped,
    on_constants,
    unwrapped,
)

#: Standard over median absolute deviation of a normal distribution: 1 / Phi^-1(3/4).
SD_OVER_MAD = 1.4826


def values_of(value: Tensor) -> Tensor:
    """The numbers behind the wrappers of ``torch.func``, mapped axes and all: for checks alone.

    A mapped tensor refuses to say whether its entries are, say, finite; the tensor behind it does
    not, for all items at once.

    Raises:
        NotImplementedError: PyTorch records what is computed, for other numbers than these.
    """
    if is_recorded() and not torch.compiler.is_compiling():
        raise NotImplementedError(
            "torch.func.linearize and make_fx record operations for any numbers, but here numbers "
            "decide what is computed; take torch.func.jvp for each direction, which differentiates "
            "at these, or jacfwd for all"
        )
    if not is_in_func():
        return value.detach().resolve_neg()
    while is_wrapped(value):
        value = unwrapped(value)
    with on_constants():  # else it would be wrapped again
        return value.detach().resolve_neg()


def has_values(value: Tensor) -> bool:
    """Whether a tensor is one of numbers: not mapped by ``torch.func``, nor without data."""
    return not is_wrapped(value) and value.device.type != "meta"


def is_mapped(value: Tensor) -> bool:
    """Whether ``torch.func.vmap`` maps a tensor: it stands for many at once."""
    if torch.compiler.is_compiling():
        return False
    while isinstance(value, Tensor) and is_wrapped(value):
        if is_batched(value):
            return True
        value = unwrapped(value)
    return False


def asks_derivative(value: Tensor) -> bool:
    """Whether a derivative by a tensor is asked for, in either mode, by the outermost transform."""
    if value.requires_grad or value.layout is not torch.strided:  # forward mode has no sparse ones
        return value.requires_grad
    return forward_ad.unpack_dual(value).tangent is not None


def without_mapping(value: Tensor) -> Tensor:
    """A tensor without the axes that ``torch.func.vmap`` maps, as far as no derivative is asked of
    it: there it stays as it is, for ``require_constant`` to refuse."""
    inner = value
    while is_mapped(inner) and (is_batched(inner) or not asks_derivative(inner)):
        inner = unwrapped(inner)
    return inner


def require_unmapped(**given: Tensor) -> None:
    """Refuse tensors that ``torch.func.vmap`` maps, where numbers decide what is computed.

    Raises:
        NotImplementedError: a tensor stands for many.
    """
    for name, value in given.items():
        if is_mapped(value):
            raise NotImplementedError(
                f"{name} is mapped by torch.func.vmap, but its numbers decide what is computed; "
                "call once for each item and stack what comes"
            )


def to_numpy(name: str, value: Tensor) -> np.ndarray:
    """The numbers of a tensor as an array, without derivatives, within ``torch.func`` too.

    There PyTorch refuses to show the memory even of a constant. A caller who would drop a
    derivative refuses it first, by ``require_constant``.

    Returns:
        An array that shares the tensor's memory.

    Raises:
        NotImplementedError: it is mapped by ``torch.func.vmap``.
    """
    require_unmapped(**{name: value})
    with on_constants():
        return values_of(value).numpy()


def anywhere(mask: Tensor) -> bool:
    """Whether an entry is true, of any item that ``torch.func`` maps."""
    return bool((mask if torch.compiler.is_compiling() else values_of(mask)).any())
