"""Solids in their own frame: signed distance and normal, both differentiable once.

``phi`` is negative inside, ``normal`` is the gradient of phi (unit, outwards). Where phi has a
kink (medial axis, on an edge) one of the adjoining normals is returned, and its gradient there.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffsim.contact.handles import new_handle
from diffsim.core.check import LEAST, require, require_range
from diffsim.core.checked import checked
from diffsim.core.layer import may_be_differentiated, outside_of_graphs
from diffsim.core.numbers import anywhere, values_of
from diffsim.core.torch_names import is_in_func
from diffsim.core.values import Number, Vector, direction, dot, scalar, vector
from diffsim.mesh import primitive
from diffsim.mesh.sdf import Sdf

Pair = tuple[Tensor, Tensor]
_Z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


class Shape:
    """What all shapes share; subclasses give ``_solid``.

    Args:
        inside_out: Whether solid and void are swapped: a sphere becomes a spherical container.
    """

    can_tunnel = True
    """Whether a straight path can enter and come out on another side (False for a half space)."""
    in_one_graph = True
    """Whether ``torch.compile(fullgraph=True)`` can hold distance and normal."""
    _solid_is_convex = False

    def __init__(self, inside_out: bool = False):
        self.inside_out = bool(inside_out)
        self.handle = new_handle(self)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "handle"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.handle = new_handle(self)  # a copy is another shape

    @property
    def convex(self) -> bool:
        """Whether the solid is convex, so that phi is convex along every straight path."""
        return self._solid_is_convex and not self.inside_out

    @checked(x=("...", 3))
    def distance_normal(self, x: Tensor) -> Pair:
        """Signed distance and outward unit normal.

        Args:
            x: Points in the shape's frame, (..., 3) [m].

        Returns:
            phi, (...) [m], negative inside, and the normal, (..., 3). Gradients: x and the
            shape's parameters; first order.
        """
        return self.evaluate(require("x", x, ("...", 3)))

    @checked(x=("...", 3))
    def __call__(self, x: Tensor) -> Tensor:
        """Signed distance alone, so that meshes and flows can be made of the shape, too.

        Args:
            x: Points in the shape's frame, (..., 3) [m].

        Returns:
            phi, (...) [m], negative inside.
        """
        return self.distance_normal(x)[0]

    def evaluate(self, x: Tensor) -> Pair:
        """``distance_normal`` of points that are checked already."""
        phi, normal = self._solid(x)
        return (-phi, -normal) if self.inside_out else (phi, normal)

    def _solid(self, x: Tensor) -> Pair:
        raise NotImplementedError


class Plane(Shape):
    """Half space n.x <= offset, n the normalized ``normal``; exact everywhere.

    Args:
        normal: Outward normal of any length > 0, (3,).
        offset: Distance of the surface from the origin along the unit normal [m].
    """

    can_tunnel = False
    _solid_is_convex = True

    def __init__(self, normal: Vector, offset: Number = 0.0, *, inside_out: bool = False):
        super().__init__(inside_out)
        n = vector("normal", normal)
        if anywhere(~(n.norm() > LEAST)):
            raise ValueError("normal must not be zero; (0, 0, 1) is a floor")
        self.normal, self.offset = n / n.norm(), scalar("offset", offset)

    def _solid(self, x: Tensor) -> Pair:
        return primitive.half_space(x, self.normal, self.offset)


class Sphere(Shape):
    """Ball about the origin. At its center: normal +z, gradients zero.

    Args:
        radius: Radius [m], > 0.
    """

    _solid_is_convex = True

    def __init__(self, radius: Number, *, inside_out: bool = False):
        super().__init__(inside_out)
        self.radius = scalar("radius", radius, above=0.0)

    def _solid(self, x: Tensor) -> Pair:
        return primitive.ball(x, self.radius)


class Capsule(Shape):
    """Points within ``radius`` of a segment. On the segment: one normal across it, gradients zero.

    Args:
        start, end: Ends of the segment, (3,) [m]; they must differ.
        radius: Radius [m], > 0.
    """

    _solid_is_convex = True

    def __init__(self, start: Vector, end: Vector, radius: Number, *, inside_out: bool = False):
        super().__init__(inside_out)
        self.start, self.end = vector("start", start), vector("end", end)
        self.radius = scalar("radius", radius, above=0.0)
        self._across = primitive.across_of(self.start, self.end)

    def _solid(self, x: Tensor) -> Pair:
        return primitive.capsule(x, self.start, self.end, self.radius, self._across)


class Box(Shape):
    """Box about the origin, edges along the axes; exact inside and outside.

    Outside, near edges and corners, the normal turns from one face to the next (rounded); inside
    and on the surface it is that of the nearest face, the first axis where two are equally near.

    Args:
        size: Edge lengths, (3,) [m], > 0.
    """

    _solid_is_convex = True

    def __init__(self, size: Vector, *, inside_out: bool = False):
        super().__init__(inside_out)
        self.size = vector("size", size)
        require_range("size", self.size, above=0.0, hint="unit is m")

    def _solid(self, x: Tensor) -> Pair:
        return primitive.box(x, self.size)


class Trough(Shape):
    """One-sided sheet: the inside of a cylinder's arc, solid behind it.

    Within the arc phi = radius - distance from the axis; elsewhere there is no obstacle and phi is
    the distance to the arc's nearer rim (so behind the sheet it jumps at the rim). On the axis:
    normal -``start``, gradients zero.

    Args:
        radius: Radius [m], > 0.
        angle: Opening of the arc [rad], in (0, 2 pi).
        axis: Axis of the cylinder through the origin, (3,).
        start: Direction of the arc's first rim, (3,), perpendicular to ``axis``; the arc goes
            right-handed about ``axis``.
    """

    def __init__(
        self,
        radius: Number,
        angle: float,
        *,
        axis: Vector = (0.0, 1.0, 0.0),
        start: Vector = (0.0, 0.0, -1.0),
        inside_out: bool = False,
    ):
        super().__init__(inside_out)
        self.radius = scalar("radius", radius, above=0.0)
        self.angle = scalar("angle", angle, above=0.0, below=2.0 * torch.pi, hint="unit is rad")
        a, s = vector("axis", axis), vector("start", start)
        if anywhere(~((a.norm() > LEAST) & (s.norm() > LEAST))):
            raise ValueError("axis and start must not be zero")
        self.axis, self.start = a / a.norm(), s / s.norm()
        cosine = values_of(dot(self.axis, self.start))
        if float(cosine.abs().max()) > 1e-9:
            raise ValueError(
                f"start must be perpendicular to axis, got cosine {float(cosine.abs().max()):.3g}"
            )

    def _solid(self, x: Tensor) -> Pair:
        across = x - (x @ self.axis)[..., None] * self.axis
        length, outwards = direction(across, self.start)
        side = torch.linalg.cross(self.axis, self.start)
        angle = torch.atan2(across.detach() @ side.detach(), across.detach() @ self.start.detach())
        angle = torch.where(angle < 0, angle + 2.0 * torch.pi, angle)
        opening = self.angle.detach()
        after = (2.0 * torch.pi + opening) / 2.0  # from here on the first rim is nearer
        rim = torch.where((angle < after)[..., None], self._rim(side), self.radius * self.start)
        to_rim, from_rim = direction(across - rim, self.start)
        within = (angle > 0) & (angle < opening)
        return (
            torch.where(within, self.radius - length, to_rim),
            torch.where(within[..., None], -outwards, from_rim),
        )

    def _rim(self, side: Tensor) -> Tensor:
        return self.radius * (torch.cos(self.angle) * self.start + torch.sin(self.angle) * side)


class Custom(Shape):
    """Any signed-distance function of ``diffsim.mesh.sdf``'s kind; its normal by autograd.

    The normal is the function's normalized gradient, so it is a unit vector even where phi is
    only a bound. Where the gradient vanishes: normal +z, gradients zero.

    Args:
        sdf: Callable (N, 3) [m] -> (N,) [m] in torch, negative inside, twice differentiable
            almost everywhere; tensors that it holds get gradients.
    """

    in_one_graph = False  # its normal is a gradient, of which a graph has no second one

    def __init__(self, sdf: Sdf, *, inside_out: bool = False):
        super().__init__(inside_out)
        if not callable(sdf):
            raise TypeError(f"sdf must be callable, got {type(sdf).__name__}")
        self.sdf = sdf

    def _solid(self, x: Tensor) -> Pair:
        return outside_of_graphs(self._by_gradient)(x)

    def _by_gradient(self, x: Tensor) -> Pair:
        if is_in_func():
            raise NotImplementedError(
                "Custom takes its normal from torch.autograd, which torch.func cannot look into: "
                "ask torch.autograd for the derivative, or use a shape with a normal of its own"
            )
        flat = x.reshape(-1, 3)
        keep = may_be_differentiated()
        with torch.enable_grad():
            # evaluated twice: a kink that spoils the normal's gradient must not spoil that of phi
            phi = self._distance(_stop_infinite_gradients(flat))
            leaf = _stop_infinite_gradients(flat)
            (slope,) = torch.autograd.grad(self._distance(leaf).sum(), leaf, create_graph=keep)
        normal = direction(slope, _Z, tiny=1e-12)[1]
        if not keep:
            phi, normal = phi.detach(), normal.detach()
        return phi.reshape(x.shape[:-1]), normal.reshape(x.shape)

    def _distance(self, x: Tensor) -> Tensor:
        phi = self.sdf(x)
        if not isinstance(phi, Tensor) or phi.shape != (len(x),):
            got = tuple(phi.shape) if isinstance(phi, Tensor) else type(phi).__name__
            raise ValueError(f"sdf must return one distance per point, ({len(x)},), got {got}")
        return phi


def _stop_infinite_gradients(x: Tensor) -> Tensor:
    """A copy of x, part of its graph, to which gradients that are not finite flow back as zero."""
    copy = x.clone()  # a tangent of forward mode stays; detach() would drop it
    if not copy.requires_grad:
        copy.requires_grad_()
    copy.register_hook(_zero_infinite)
    return copy


def _zero_infinite(grad: Tensor | None) -> Tensor | None:
    return None if grad is None else torch.nan_to_num(grad, nan=0.0, posinf=0.0, neginf=0.0)
