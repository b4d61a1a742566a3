"""What all level sets of the flow share.

Sign: phi > 0 in the FLUID, phi < 0 in the solid (the thesis, 4.2.5, has it the other way round).
A solid given as a signed distance of ``diffsim.mesh.sdf`` (negative inside the solid) fits as is.

Shapes made of shapes are always in terms of the FLUID regions. Walls add up by ``Intersection``:
fluid is where no wall is. The interface is exact; away from it phi is a bound of the distance with
the right sign. Where two shapes are equal (a tie) the gradient goes to the first of them, in the
order given, never to both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor, nn

from diffsim.core.check import LARGEST, require, require_choice, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.module import Float64Module
from diffsim.core.numbers import anywhere, values_of
from diffsim.core.values import joined

LevelSet = Callable[[Tensor], Tensor]
Vector = Sequence[float] | Tensor

_LEAST_WEIGHT = 1e-100
"""Squares of smaller numbers are none, nor are those of their inverses."""


class Shape(Float64Module):
    """A level set: phi > 0 in the fluid, < 0 in the solid; subclasses give ``level``.

    Parameters may be numbers, tensors (part of the caller's graph) or ``nn.Parameter`` (then among
    ``shape.parameters()``). Gradients: points and all parameters, first order, reverse and
    forward mode.

    Attributes:
        dim: Dimension of the points, 2 or 3; None where any will do.
    """

    dim: int | None = None

    @checked
    def forward(self, points: Tensor) -> Tensor:
        """Level set at points.

        Args:
            points: Points, (..., d) float64 [m].

        Returns:
            phi, (...) [m], > 0 in the fluid, < 0 in the solid.

        Raises:
            ValueError: wrong dimension, NaN, or parameters that give no finite phi.
        """
        flat = require("points", points, ("...", "d" if self.dim is None else self.dim))
        flat = flat.reshape(-1, flat.shape[-1])
        phi = self.level(flat)
        if anywhere(~torch.isfinite(phi)):
            raise ValueError(
                f"{type(self).__name__} gives no finite phi at {_first_bad(flat, phi)}; "
                "look for NaN in its parameters"
            )
        return phi.reshape(points.shape[:-1])

    def level(self, points: Tensor) -> Tensor:
        """phi (N,) at points (N, d) that are checked already."""
        raise NotImplementedError

    def __or__(self, other: LevelSet) -> Shape:
        """Fluid where either has fluid."""
        return Union(self, other)

    def __and__(self, other: LevelSet) -> Shape:
        """Fluid where both have fluid."""
        return Intersection(self, other)

    def __invert__(self) -> Shape:
        """Fluid and solid swapped."""
        return Complement(self)


class Custom(Shape):
    """Any level set: a function or ``nn.Module``, phi > 0 in the fluid.

    phi need not be a distance, but its slope should be near 1 m/m at the interface, and not zero.

    Args:
        level_set: Callable (N, d) [m] -> (N,) [m] in torch; tensors that it holds get gradients.
        dim: Dimension of its points, 2 or 3; None takes both.
    """

    def __init__(self, level_set: LevelSet, *, dim: int | None = None):
        super().__init__()
        if not callable(level_set):
            raise TypeError(f"level_set must be callable, got {type(level_set).__name__}")
        if dim not in (None, 2, 3):
            raise ValueError(f"dim must be 2, 3 or None, got {dim}")
        self.level_set, self.dim = level_set, dim

    def level(self, points: Tensor) -> Tensor:
        phi = self.level_set(points)
        if not isinstance(phi, Tensor) or phi.shape != (len(points),):
            got = tuple(phi.shape) if isinstance(phi, Tensor) else type(phi).__name__
            raise ValueError(
                f"level_set must return one value per point, ({len(points)},), got {got}"
            )
        return phi


def as_shape(name: str, shape: LevelSet) -> Shape:
    """A shape, or a callable wrapped into one."""
    if isinstance(shape, Shape):
        return shape
    if not callable(shape):
        raise TypeError(f"{name} must be a shape or a callable, got {type(shape).__name__}")
    return Custom(shape)


class Combination(Shape):
    """A level set joined from those of several shapes, one after the other."""

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


class Union(Combination):
    """Fluid where any of the shapes has fluid: phi = max (solid is what all share)."""

    def _join(self, a: Tensor, b: Tensor) -> Tensor:
        return torch.where(b.detach() > a.detach(), b, a)


class Intersection(Combination):
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


def vector(name: str, value: Vector, dims: tuple[int, ...]) -> Tensor:
    """Finite numbers or a tensor of one of the lengths as float64 tensor; gradients are kept."""
    if isinstance(value := joined(value), Tensor):
        v = require(name, value, ("d",))
    else:
        try:
            numbers = [require_number(name, float(number)) for number in value]
            v = torch.tensor(numbers, dtype=torch.float64)
        except (TypeError, ValueError):
            v = torch.empty(0, dtype=torch.float64)
    if len(v) not in dims:
        raise ValueError(f"{name} must be {' or '.join(map(str, dims))} numbers, got {value!r}")
    return require_range(name, v, at_least=-LARGEST, at_most=LARGEST)


def outwards(fluid: str) -> float:
    """1 where the fluid is outside of a closed shape, -1 where it is inside."""
    return 1.0 if require_choice("fluid", fluid, ("inside", "outside")) == "outside" else -1.0


def _first_bad(points: Tensor, phi: Tensor) -> tuple[float, ...]:
    at, numbers = values_of(points), values_of(phi)
    which = int(torch.nonzero(~torch.isfinite(numbers).flatten())[0, 0])
    return tuple(at.reshape(-1, points.shape[-1])[which % len(points)].tolist())


def require_weights(weights: Tensor, shape: Sequence[int], most: float) -> Tensor:
    """Check weights of control points: > 0, and near enough to one another to be computed with.

    Where one outweighs the others, most of the shape lies within a tiny piece of the parameter.

    Args:
        shape: Shape that they must have.
        most: Largest weight per smallest.
    """
    weights = require("weights", weights, shape)
    require_range("weights", weights, above=0.0, at_most=1.0 / _LEAST_WEIGHT)
    low, high = (float(extreme) for extreme in torch.aminmax(values_of(weights)))
    if low < _LEAST_WEIGHT or high > most * low:
        raise ValueError(
            f"weights must lie within a factor of {most:g} and above {_LEAST_WEIGHT:g}, got "
            f"{low:g} to {high:g}"
        )
    return weights
