"""Where a straight path first enters a shape: sphere tracing, then Newton near the surface."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.contact.handles import shape_of
from diffsim.contact.shapes import Shape
from diffsim.core.layer import custom_op
from diffsim.core.values import dot

_NEAR = 1.0 / 32.0
"""Nearer than this share of the path, steps are Newton's (or this long, moving away)."""
_TOUCH = 1e-9
_STEEP = 0.5
"""Sine of the angle to the surface from which passing in and out again is no grazing."""
_MAX_ITERS = 200


@torch.no_grad()
def first_entry(
    shape: Shape,
    y0: Tensor,
    y1: Tensor,
    start_distance: Tensor,
    end_distance: Tensor,
    end_normal: Tensor,
) -> Tensor:
    """Parameter in [0, 1] where paths enter a shape that they leave on another side.

    A path counts when the normals where it enters and at its end are 90 degrees or more apart, or
    when it enters by 30 degrees or steeper and ends outside; a path that starts inside counts from
    its start while it goes deeper. Grazing a bulge, as in sliding along it, does not count.

    Args:
        shape: The shape; its phi must not exceed the distance.
        y0, y1: Ends of the paths in the shape's frame, (N, 3) [m].
        start_distance: phi at y0, (N,) [m].
        end_distance, end_normal: phi and normal at y1, (N,) [m], (N, 3).

    Returns:
        Parameters, (N,), inf where no path counts. A shape thinner than the path's length / 32
        can be missed where the path meets it while its phi has a kink (concave edges).
    """
    entry = torch.full_like(end_distance, math.inf)
    length = (y1 - y0).norm(dim=-1)
    # phi falls no faster than the path goes: too far to touch and come back
    rows = torch.nonzero(
        (length > 0) & (start_distance + end_distance.clamp(min=0.0) <= length)
    ).flatten()
    t = torch.zeros(len(rows), dtype=y0.dtype)
    for _ in range(_MAX_ITERS):
        if not len(rows):
            break
        path, far = y1[rows] - y0[rows], length[rows]
        phi, normal = shape.evaluate(y0[rows] + t[:, None] * path)
        fall = -dot(normal, path) / far
        entered = (phi <= _TOUCH * far) & (fall > 0)
        passed = (end_distance[rows] > 0) & (fall > _STEEP)
        other_side = (dot(normal, end_normal[rows]) <= 0) | passed
        hit = entered & other_side
        entry[rows[hit]] = t[hit]
        newton = phi / fall.clamp(min=1e-9)
        crawl = torch.where((fall > 0) & (phi > 0), newton, _NEAR * far)
        step = torch.where(phi.abs() > _NEAR * far, phi.abs(), crawl)
        t = t + step / far
        go_on = ~entered & (t <= 1.0)
        if shape.convex:  # phi is convex along the path: once it rises, it never falls again
            go_on &= fall > 0
        rows, t = rows[go_on], t[go_on]
    return entry


@custom_op("diffsim::contact_first_entry")
def first_entry_in_graph(
    y0: Tensor,
    y1: Tensor,
    start_distance: Tensor,
    end_distance: Tensor,
    end_normal: Tensor,
    *,
    handle: int,
) -> Tensor:
    """:func:`first_entry` of the shape with a handle: a graph holds no search by values."""
    shape = shape_of(handle, Shape)
    return first_entry(shape, y0, y1, start_distance, end_distance, end_normal)


@first_entry_in_graph.register_fake
def _(*given: Tensor, handle: int) -> Tensor:
    return torch.empty_like(given[3])
