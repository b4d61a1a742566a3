"""The numbers behind tensors, where ``torch.func`` wraps them too."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.layer import on_constants

_FUNC = torch._C._functorch  # PyTorch has no public name for what is behind a wrapper


def values_of(value: Tensor) -> Tensor:
    """The numbers behind the wrappers of ``torch.func``, mapped axes and all: for checks alone.

    A mapped tensor refuses to say whether its entries are, say, finite; the tensor behind it does
    not, for all items at once.
    """
    if _FUNC.maybe_current_level() is None:
        return value.detach()
    while _FUNC.is_functorch_wrapped_tensor(value):
        value = _FUNC.get_unwrapped(value)
    with on_constants():  # else it would be wrapped again
        return value.detach()


def has_values(value: Tensor) -> bool:
    """Whether a tensor is one of numbers: not mapped by ``torch.func``, nor without data."""
    return not _FUNC.is_functorch_wrapped_tensor(value) and value.device.type != "meta"


def is_mapped(value: Tensor) -> bool:
    """Whether ``torch.func.vmap`` maps a tensor: it stands for many at once."""
    if torch.compiler.is_compiling():
        return False
    while isinstance(value, Tensor) and _FUNC.is_functorch_wrapped_tensor(value):
        if _FUNC.is_batchedtensor(value):
            return True
        value = _FUNC.get_unwrapped(value)
    return False


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

    Args:
        name: What it is, for the message.
        value: Tensor on the CPU.

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
