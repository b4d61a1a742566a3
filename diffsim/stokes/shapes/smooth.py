"""Shapes joined smoothly, in terms of their FLUID regions, phi > 0."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.values import Number, scalar
from diffsim.stokes.shapes.base import Combination, LevelSet


class SmoothUnion(Combination):
    """``Union`` with the fluid's inner corners filleted; phi has a continuous gradient.

    phi = (a + b)/2 + ((a - b)^2 + r^2)/(4 r) where |a - b| < r, else max(a, b): never below the
    sharp union and at most r/4 above. More than two shapes are joined one after the other.

    Args:
        *shapes: Level sets.
        radius: Width r of the blend [m], > 0.
    """

    _sign = 1.0

    def __init__(self, *shapes: LevelSet, radius: Number):
        super().__init__(*shapes)
        self.radius = scalar("radius", radius, above=0.0)

    def _join(self, a: Tensor, b: Tensor) -> Tensor:
        a, b = self._sign * a, self._sign * b
        gap, r = a - b, self.radius
        blend = 0.5 * (a + b) + (gap**2 + r**2) / (4.0 * r)
        sharp = torch.where(gap.detach() < 0, b, a)
        return self._sign * torch.where(gap.detach().abs() < r.detach(), blend, sharp)


class SmoothIntersection(SmoothUnion):
    """``Intersection`` with the solids' inner corners filleted: the mirror of ``SmoothUnion``."""

    _sign = -1.0
