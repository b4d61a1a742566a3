"""Shapes made of shapes, always in terms of the FLUID regions, phi > 0.

Walls add up by ``Intersection``: fluid is where no wall is. The interface is exact; away from it
phi is a bound of the distance with the right sign. Where two shapes are equal (a tie) the gradient
goes to the first of them, in the order given, never to both.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from diffsim.stokes.shapes.base import LevelSet, Number, Shape, as_shape, scalar


class _Combination(Shape):
    def __init__(self, *shapes: LevelSet):
        super().__init__()
        if not shapes:
            raise ValueError("at least one shape is needed, got none")
        parts = [as_shape("shape", s) for s in shapes]
        self.shapes = nn.ModuleList(parts)
        dims = {s.dim for s in parts if s.dim is not None}
        if len(dims) > 1:
            raise ValueError("shapes in 2D and 3D cannot be combined; use Extrude for the 2D ones")
        self.dim = dims.pop() if dims else None

    def level(self, points: Tensor) -> Tensor:
        first, *others = cast(list[Shape], list(self.shapes))
        phi = first.level(points)
        for shape in others:
            phi = self._join(phi, shape.level(points))
        return phi

    def _join(self, a: Tensor, b: Tensor) -> Tensor:
        raise NotImplementedError


class Union(_Combination):
    """Fluid where any of the shapes has fluid: phi = max (solid is what all share)."""

    def _join(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b.detach() > a.detach(), b, a)


class Intersection(_Combination):
    """Fluid where all of the shapes have fluid: phi = min (the solids are united)."""

    def _join(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b.detach() < a.detach(), b, a)


class Complement(Shape):
    """Fluid and solid swapped: phi = -phi of the shape."""

    def __init__(self, shape: LevelSet):
        super().__init__()
        self.shape = as_shape("shape", shape)
        self.dim = self.shape.dim

    def level(self, points: Tensor) -> Tensor:
        return -self.shape.level(points)


class SmoothUnion(_Combination):
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
