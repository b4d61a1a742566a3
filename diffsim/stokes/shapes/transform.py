"""Shapes moved, turned and extruded; gradients to the motion. phi > 0 stays in the fluid."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import LEAST, require_choice
from diffsim.core.layer import is_followed
from diffsim.core.numbers import anywhere
from diffsim.core.values import Number, scalar
from diffsim.stokes.shapes.base import LevelSet, Shape, Vector, as_shape, vector

_AXES = ("x", "y", "z")


class Translate(Shape):
    """The shape moved by a vector.

    Args:
        shape: Level set.
        by: Displacement, (d,) [m].
    """

    def __init__(self, shape: LevelSet, by: Vector):
        super().__init__()
        self.shape, self.by = as_shape("shape", shape), vector("by", by, (2, 3))
        self.dim = len(self.by)
        if self.shape.dim not in (None, self.dim):
            raise ValueError(f"by must have {self.shape.dim} entries, got {self.dim}")

    def level(self, points: Tensor) -> Tensor:
        return self.shape.level(points - self.by)


class Rotate(Shape):
    """The shape turned by an angle, right-handed about an axis (3D) or counter-clockwise (2D).

    phi(x) = phi0(c + R' (x - c)), R = I + sin(angle) K + (1 - cos(angle)) K K (Rodrigues).

    Args:
        shape: Level set.
        angle: Angle [rad].
        axis: Direction of the axis, (3,), of any length > 0; None in the plane.
        center: A point c that stays in place, (d,) [m]; the origin if None.
    """

    def __init__(
        self,
        shape: LevelSet,
        angle: Number,
        *,
        axis: Vector | None = (0.0, 0.0, 1.0),
        center: Vector | None = None,
    ):
        super().__init__()
        self.shape, self.angle = as_shape("shape", shape), scalar("angle", angle)
        self.dim = 2 if self.shape.dim == 2 or axis is None else 3
        self.axis = None if self.dim == 2 else vector("axis", axis, (3,))  # type: ignore[arg-type]
        if self.shape.dim not in (None, self.dim):
            raise ValueError("axis must be given to rotate a shape in 3D")
        self.center = vector("center", [0.0] * self.dim if center is None else center, (self.dim,))
        self.matrix()

    def matrix(self) -> Tensor:
        """R, (d, d): shape's frame to world."""
        sin, cos = torch.sin(self.angle), torch.cos(self.angle)
        if self.axis is None:
            return torch.stack([cos, -sin, sin, cos]).reshape(2, 2)
        length = self.axis.norm()
        if anywhere(~(length > LEAST)):
            raise ValueError("axis must not be zero; (0, 0, 1) is vertical")
        x, y, z = self.axis / length
        o = torch.zeros_like(x)
        cross = torch.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3)
        eye = torch.eye(3, dtype=torch.float64)
        return eye + sin * cross + (1.0 - cos) * cross @ cross

    def level(self, points: Tensor) -> Tensor:
        away = points - self.center
        return self.shape.level(self.center + away @ self.matrix())  # rows: R' x


class Extrude(Shape):
    """A 2D shape made 3D: constant along a coordinate axis, without end.

    Close it with planes: ``Extrude(outline) & Plane((0, 0, 1)) & Plane((0, 0, -1), -height)``;
    other directions by ``Rotate``.

    Args:
        shape: Level set in the plane; its two coordinates are those of x, y, z that remain, in
            this order ("z": (x, y); "y": (x, z); "x": (y, z)).
        axis: Axis of the extrusion, "x", "y" or "z".
    """

    dim = 3

    def __init__(self, shape: LevelSet, axis: str = "z"):
        super().__init__()
        self.shape = as_shape("shape", shape)
        if self.shape.dim == 3:
            raise ValueError("only a shape in the plane can be extruded, got one in 3D")
        along = _AXES.index(require_choice("axis", axis, _AXES))
        self.across = [i for i in range(3) if i != along]

    def level(self, points: Tensor) -> Tensor:
        flat = points[:, self.across].contiguous()
        if is_followed([flat]):
            return self.shape.level(flat)
        # the nodes of a grid lie above each other: each place in the plane once
        as_complex = flat.detach().numpy().view(np.complex128)[:, 0]
        _, first, column = np.unique(as_complex, return_index=True, return_inverse=True)
        return self.shape.level(flat[torch.from_numpy(first)])[torch.from_numpy(column)]
