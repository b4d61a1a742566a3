"""Solids as signed distance: callables (N, 3) [m] -> (N,) [m], negative inside.

Primitives and rigid motions give the exact distance; union, intersection and difference give the
exact surface and, away from it, a bound. All work on torch tensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from diffsim.core.check import LARGEST, LEAST, require_number, require_range
from diffsim.core.values import Vector, scalar, vector
from diffsim.mesh import primitive

Sdf = Callable[[Tensor], Tensor]


def sphere(radius: float, center: Vector = (0.0, 0.0, 0.0)) -> Sdf:
    """Ball of a radius [m]."""
    r = scalar("radius", radius, above=0.0)
    c = vector("center", center)
    return lambda x: primitive.ball(x - c, r)[0]


def box(size: Vector, center: Vector = (0.0, 0.0, 0.0)) -> Sdf:
    """Axis-aligned box with edge lengths ``size`` [m]."""
    edges = vector("size", size)
    require_range("size", edges, above=0.0, hint="unit is m")
    c = vector("center", center)
    return lambda x: primitive.box(x - c, edges)[0]


def cylinder(radius: float, height: float, center: Vector = (0.0, 0.0, 0.0)) -> Sdf:
    """Cylinder along z, radius and full height [m]."""
    radius = _size("radius", radius)
    half = 0.5 * _size("height", height)
    c = vector("center", center)

    def distance(x: Tensor) -> Tensor:
        y = x - c
        q = torch.stack([y[:, :2].norm(dim=1) - radius, y[:, 2].abs() - half], dim=1)
        return q.clamp(min=0.0).norm(dim=1) + q.max(dim=1).values.clamp(max=0.0)

    return distance


def capsule(start: Vector, end: Vector, radius: float) -> Sdf:
    """All points within ``radius`` [m] of the segment from ``start`` to ``end``."""
    r = scalar("radius", radius, above=0.0)
    a, b = vector("start", start), vector("end", end)
    across = primitive.across_of(a, b)
    return lambda x: primitive.capsule(x, a, b, r, across)[0]


def torus(major_radius: float, minor_radius: float, center: Vector = (0.0, 0.0, 0.0)) -> Sdf:
    """Ring around the z axis: circle of ``major_radius``, tube of ``minor_radius`` [m]."""
    minor = _size("minor_radius", minor_radius)
    major = _size("major_radius", major_radius, above=minor)
    c = vector("center", center)

    def distance(x: Tensor) -> Tensor:
        y = x - c
        return torch.hypot(torch.hypot(y[:, 0], y[:, 1]) - major, y[:, 2]) - minor

    return distance


def plane(normal: Vector, offset: float = 0.0) -> Sdf:
    """Half space n.x <= offset [m], n the normalized outward normal."""
    n = vector("normal", normal)
    if not float(n.norm()) > LEAST:
        raise ValueError("normal must not be zero")
    n = n / n.norm()
    away = scalar("offset", offset)
    return lambda x: primitive.half_space(x, n, away)[0]


def union(*shapes: Sdf) -> Sdf:
    """Points in any of the shapes."""
    _some(shapes)
    return lambda x: torch.stack([s(x) for s in shapes]).min(dim=0).values


def ellipsoid(half: Vector, center: Vector = (0.0, 0.0, 0.0)) -> Sdf:
    """Ellipsoid with half axes ``half`` along x, y, z [m]; exact where it is zero, else nearly."""
    r, c = vector("half", half), vector("center", center)
    require_range("half", r, above=0.0, hint="unit is m")

    def distance(x: Tensor) -> Tensor:
        q = (x - c) / r
        length, slope = q.norm(dim=1), (q / r).norm(dim=1).clamp(min=1e-9 / float(r.max()))
        return length * (length - 1.0) / slope

    return distance


def smooth_union(a: Sdf, b: Sdf, width: float) -> Sdf:
    """Union whose seam is rounded where the two distances differ by less than ``width`` [m]."""
    width = _size("width", width)

    def distance(x: Tensor) -> Tensor:
        p, q = a(x), b(x)
        near = (1.0 - (p - q).abs() / width).clamp(min=0.0)
        return torch.minimum(p, q) - 0.25 * width * near**2

    return distance


def intersection(*shapes: Sdf) -> Sdf:
    """Points in all of the shapes."""
    _some(shapes)
    return lambda x: torch.stack([s(x) for s in shapes]).max(dim=0).values


def difference(shape: Sdf, *cutters: Sdf) -> Sdf:
    """Points in ``shape`` but in none of the cutters."""
    _some(cutters)
    return lambda x: torch.stack([shape(x), *(-c(x) for c in cutters)]).max(dim=0).values


def translate(shape: Sdf, by: Vector) -> Sdf:
    """The shape moved by a vector [m]."""
    offset = vector("by", by)
    return lambda x: shape(x - offset)


def rotate(shape: Sdf, axis: Vector, angle: float) -> Sdf:
    """The shape turned about an axis through the origin by an angle [rad], right-handed."""
    a = vector("axis", axis)
    if not float(a.norm()) > LEAST:
        raise ValueError("axis must not be zero")
    kx, ky, kz = (a / a.norm()).tolist()
    cross = torch.tensor([[0.0, -kz, ky], [kz, 0.0, -kx], [-ky, kx, 0.0]], dtype=torch.float64)
    angle = require_number("angle", angle)
    turn = (  # Rodrigues: R = I + sin K + (1 - cos) K K
        torch.eye(3, dtype=torch.float64)
        + math.sin(angle) * cross
        + (1.0 - math.cos(angle)) * cross @ cross
    )
    return lambda x: shape(x @ turn)  # rows: R' x


def offset(shape: Sdf, by: float) -> Sdf:
    """The shape grown (by > 0) or shrunk by a distance [m]; grown edges become round."""
    by = require_number("by", by)
    return lambda x: shape(x) - by


def shell(shape: Sdf, thickness: float) -> Sdf:
    """The points within half a thickness [m] of the shape's surface."""
    half = 0.5 * _size("thickness", thickness)
    return lambda x: shape(x).abs() - half


def _size(name: str, value: float, above: float = 0.0) -> float:
    return require_number(name, value, above=above, at_most=LARGEST, hint="unit is m")


def _some(shapes: Sequence[Sdf]) -> None:
    if not shapes:
        raise ValueError("at least one shape is needed, got none")
