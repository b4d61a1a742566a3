"""Rotations from rotation vectors, exact and smooth through zero."""

from __future__ import annotations

import torch
from torch import Tensor

_SERIES = 1e-2
"""Below this angle [rad] the series is used: its first neglected term is below 1e-17."""


def sinc_terms(angle_squared: Tensor) -> tuple[Tensor, Tensor]:
    """sin(a) / a and (1 - cos(a)) / a^2 as smooth functions of a^2."""
    small = angle_squared.detach() < _SERIES**2
    a2 = torch.where(small, 1.0, angle_squared)
    a = a2.sqrt()
    s2 = torch.where(small, angle_squared, 0.0)
    first = torch.where(small, 1.0 - s2 / 6 * (1.0 - s2 / 20 * (1.0 - s2 / 42)), torch.sin(a) / a)
    second = torch.where(
        small,
        0.5 * (1.0 - s2 / 12 * (1.0 - s2 / 30 * (1.0 - s2 / 56))),
        2.0 * torch.sin(0.5 * a) ** 2 / a2,
    )
    return first, second


def turn_offset(rotation_vector: Tensor, r: Tensor) -> Tensor:
    """(R - I) r for vectors r (..., 3), without cancellation for small angles."""
    first, second = sinc_terms(rotation_vector.square().sum())
    w = rotation_vector.expand_as(r)
    once = torch.linalg.cross(w, r)
    return first * once + second * torch.linalg.cross(w, once)


def rotation_matrix(rotation_vector: Tensor) -> Tensor:
    """R = I + sin(a)/a K + (1 - cos a)/a^2 K K, (3,) [rad] -> (3, 3) (Rodrigues)."""
    unit = torch.eye(3, dtype=rotation_vector.dtype)
    return unit + turn_offset(rotation_vector, unit).T  # rows: images of the unit vectors
