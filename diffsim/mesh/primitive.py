"""Signed distance and outward normal of the basic solids: the formulas that all rooms share.

``mesh.sdf`` makes meshes from them, ``contact`` obstacles, ``stokes`` walls; the sign is one,
negative in the solid. Points have shape (..., d) [m], in the solid's own frame. Gradients are those
of the nearest point, zero (never NaN) where there is none.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import LEAST
from diffsim.core.numbers import anywhere
from diffsim.core.values import direction, dot

Pair = tuple[Tensor, Tensor]


def half_space(x: Tensor, normal: Tensor, offset: Tensor) -> Pair:
    """Half space n.x <= offset.

    Args:
        x: Points, (..., d) [m].
        normal: Outward unit normal, (d,).
        offset: Distance of the surface from the origin along the normal, () [m].
    """
    return x @ normal - offset, normal.expand_as(x)


def ball(x: Tensor, radius: Tensor) -> Pair:
    """Ball (3D) or disc (2D) about the origin; at its center the normal is the last axis.

    Args:
        x: Points, (..., d) [m].
        radius: Radius, () [m].
    """
    last = torch.eye(x.shape[-1], dtype=x.dtype)[-1]
    length, normal = direction(x, last)
    return length - radius, normal


def box(x: Tensor, size: Tensor) -> Pair:
    """Box (3D) or rectangle (2D) about the origin, edges along the axes.

    Outside, near edges and corners, the normal turns from one face to the next; inside and on the
    surface it is that of the nearest face, the first axis where two are equally near.

    Args:
        x: Points, (..., d) [m].
        size: Edge lengths, (d,) [m].
    """
    side = torch.where(x.detach() < 0, -1.0, 1.0)
    beyond = side * x - 0.5 * size
    deepest = beyond.detach().argmax(-1, keepdim=True)
    face = torch.zeros_like(beyond.detach()).scatter(-1, deepest, 1.0)
    inside = beyond.gather(-1, deepest)[..., 0]
    length, outwards = direction(beyond.clamp(min=0.0), face)
    within = inside.detach() <= 0
    phi = torch.where(within, inside, length)
    return phi, side * torch.where(within[..., None], face, outwards)


def capsule(x: Tensor, start: Tensor, end: Tensor, radius: Tensor, across: Tensor) -> Pair:
    """Points within a radius of a segment.

    Args:
        x: Points, (..., 3) [m].
        start, end: Ends of the segment, (3,) [m].
        radius: Radius, () [m].
        across: Normal of points on the segment, (3,), perpendicular to it.
    """
    along = end - start
    t = (((x - start) @ along) / dot(along, along)).clamp(0.0, 1.0)
    away = x - start - t[..., None] * along
    length, normal = direction(away, across)
    return length - radius, normal


def across_of(start: Tensor, end: Tensor) -> Tensor:
    """A direction perpendicular to a segment, (3,); not normalized.

    Raises:
        ValueError: start and end are the same point.
    """
    along = (end - start).detach()
    if anywhere(~(along.norm() > LEAST)):
        raise ValueError(
            "start and end of a capsule must differ; use Sphere, or sphere as a distance"
        )
    least = torch.nn.functional.one_hot(along.abs().argmin(), 3).to(along)
    return torch.linalg.cross(along, least)
