"""Plane, sphere (circle) and box (rectangle): exact distances, phi > 0 in the fluid."""

from __future__ import annotations

from torch import Tensor

from diffsim.core.check import LEAST, require_range
from diffsim.core.numbers import anywhere
from diffsim.core.values import Number, scalar
from diffsim.mesh import primitive
from diffsim.stokes.shapes.base import Shape, Vector, outwards, vector


class Plane(Shape):
    """Half space of fluid n.x > offset, n the normalized ``normal``, in 2D or 3D.

    Args:
        normal: Points into the fluid, any length > 0, (d,).
        offset: Distance of the wall from the origin along the unit normal [m].
    """

    def __init__(self, normal: Vector, offset: Number = 0.0):
        super().__init__()
        self.normal, self.offset = vector("normal", normal, (2, 3)), scalar("offset", offset)
        self.dim = len(self.normal)
        self._unit()

    def _unit(self) -> Tensor:
        length = self.normal.norm()
        if anywhere(~(length > LEAST)):
            raise ValueError("normal must not be zero; (0, 0, 1) is a floor with fluid above")
        return self.normal / length

    def level(self, points: Tensor) -> Tensor:
        return points @ self._unit() - self.offset


class Sphere(Shape):
    """Ball (3D) or disc (2D), solid with the fluid outside by default.

    thesis 4.2.5: phi = r - |c - x| for fluid inside. At the center the gradient to the points and
    to the center is zero.

    Args:
        radius: Radius [m], > 0.
        center: Center, (2,) or (3,) [m].
        fluid: Side of the fluid, "outside" or "inside".
    """

    def __init__(self, radius: Number, center: Vector = (0.0, 0.0, 0.0), *, fluid: str = "outside"):
        super().__init__()
        self.radius = scalar("radius", radius, above=0.0)
        self.center = vector("center", center, (2, 3))
        self.sign, self.dim = outwards(fluid), len(self.center)

    def level(self, points: Tensor) -> Tensor:
        return self.sign * primitive.ball(points - self.center, self.radius)[0]


class Box(Shape):
    """Box (3D) or rectangle (2D), edges along the axes; exact inside and outside.

    Gradients: outside those of the nearest point; inside and on the surface those of the nearest
    face, the first axis where two are equally near, the positive side on a plane of symmetry.

    Args:
        size: Edge lengths, (2,) or (3,) [m], > 0.
        center: Center, (d,) [m]; the origin if None.
        fluid: Side of the fluid, "outside" or "inside".
    """

    def __init__(self, size: Vector, center: Vector | None = None, *, fluid: str = "outside"):
        super().__init__()
        self.size = vector("size", size, (2, 3))
        require_range("size", self.size, above=0.0, hint="unit is m")
        self.dim = len(self.size)
        self.center = vector("center", [0.0] * self.dim if center is None else center, (self.dim,))
        self.sign = outwards(fluid)

    def level(self, points: Tensor) -> Tensor:
        return self.sign * primitive.box(points - self.center, self.size)[0]
