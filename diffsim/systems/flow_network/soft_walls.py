"""Channels whose walls give way to the pressure.

A channel of width w (1 + c p) is linear in F(p) = ((1 + c p)^4 - 1) / (4 c), as its flow goes as
(1 + c p)^3 dp / dx where the width changes slowly along the channel; F(p) = p where c = 0.
"""

from __future__ import annotations

from torch import Tensor


def linearize_pressure(pressure: Tensor, compliance: Tensor) -> tuple[Tensor, Tensor]:
    """F(p) and its slope.

    Args:
        pressure: p [Pa].
        compliance: c, relative growth of the width per pressure [1/Pa].
    """
    x = compliance * pressure
    # ((1 + x)^4 - 1) / 4 c, without a division by c
    return pressure * (1.0 + x * (1.5 + x * (1.0 + 0.25 * x))), (1.0 + x) ** 3


def invert_linearized(value: Tensor, compliance: Tensor) -> Tensor:
    """Pressure p [Pa] of F(p).

    Args:
        value: F(p) [Pa].
        compliance: c, relative growth of the width per pressure [1/Pa].
    """
    x = 4.0 * compliance * value
    # ((1 + x)^(1/4) - 1) / c, without a division by c
    root = (1.0 + x) ** 0.25
    return 4.0 * value / ((root + 1.0) * (root**2 + 1.0))
