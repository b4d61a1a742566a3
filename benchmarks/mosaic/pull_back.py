"""What the proposed domains share: inputs as tensors, and the vector-Jacobian product."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor


def leaves_of(given: Mapping[str, Any], names: tuple[str, ...]) -> dict[str, Tensor]:
    """Inputs of these names as float64 tensors of their own."""
    return {name: torch.from_numpy(np.array(given[name], np.float64)) for name in names}


def pull_back(
    function: Callable[..., Tensor],
    leaves: Mapping[str, Tensor],
    vjp_inputs: set[str],
    cotangent: Any,
) -> dict[str, np.ndarray]:
    """Cotangents of inputs, float32; zero where the output does not depend on one.

    Args:
        function: Output of the inputs, given by name.
        leaves: Inputs by name.
        vjp_inputs: Those whose cotangents are asked for.
        cotangent: Of the output.
    """
    names = sorted(vjp_inputs)
    for name in names:
        leaves[name].requires_grad_()
    grads = torch.autograd.grad(
        function(**leaves),
        [leaves[name] for name in names],
        torch.from_numpy(np.asarray(cotangent, np.float64)),
        allow_unused=True,
    )
    return {
        name: (torch.zeros_like(leaves[name]) if grad is None else grad).numpy().astype(np.float32)
        for name, grad in zip(names, grads, strict=True)
    }
