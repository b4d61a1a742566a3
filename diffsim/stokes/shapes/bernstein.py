"""Polynomials in Bernstein form on [0, 1]: coefficients on the last axis unless said otherwise."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from diffsim.core.torch_names import on_constants


@functools.cache
@on_constants()
def binomials(degree: int) -> Tensor:
    """C(n, 0), ..., C(n, n); shared, not to be written to."""
    return torch.tensor([math.comb(degree, k) for k in range(degree + 1)], dtype=torch.float64)


def basis(t: Tensor, degree: int) -> Tensor:
    """C(n, k) t^k (1 - t)^(n - k), (..., n + 1)."""
    s = 1.0 - t
    rising, falling = [torch.ones_like(t)], [torch.ones_like(t)]
    for _ in range(degree):
        rising.append(rising[-1] * t)
        falling.append(falling[-1] * s)
    products = [up * down for up, down in zip(rising, reversed(falling), strict=True)]
    return binomials(degree) * torch.stack(products, -1)
