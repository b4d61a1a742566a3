"""Classes of ours within PyTorch's own tools: conversion of modules, loading of records."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor, nn

Record = TypeVar("Record")


def loadable(kind: type[Record]) -> type[Record]:
    """Decorator of records of tensors that ``torch.load`` may make, as it makes tensors."""
    torch.serialization.add_safe_globals([kind])
    return kind


class Float64Module(nn.Module):
    """A module whose constants stay what kernels compute with.

    ``policy.float()`` or ``policy.to("cuda")`` reaches every module within a policy, its simulator
    too. A network of another precision works beside one: ``in_float64`` converts what goes in and
    out.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Float64Module:
        made = fn(torch.zeros(1, dtype=torch.float64, device="cpu"))
        if made.dtype is torch.float64 and made.is_cpu:
            return super()._apply(fn, recurse)
        warnings.warn(
            f"{type(self).__name__} stays in float64 on the CPU, it was asked for {made.dtype} on "
            f"{made.device}; diffsim.in_float64 converts what goes in and what comes out",
            stacklevel=3,
        )
        return self
