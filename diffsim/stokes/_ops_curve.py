"""Closest points on curves as a torch custom op; everything is float64."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, make_first_order


@custom_op("diffsim::stokes_closest_on_curves")
def closest_on_curves(
    points: Tensor, homogeneous: Tensor, rays: Tensor, closed: bool, size: float
) -> tuple[Tensor, Tensor]:
    """Parameters and left unit normals; csrc/kernels/stokes/closest_curve.h.

    Args:
        points: (N, 2).
        homogeneous: (num_curves, degree + 1, 3).
        rays: (2, 2); empty where the curves do not go on beyond their ends.
        closed: Whether the last curve ends where the first one starts.
        size: Length scale [m].
    """
    sizes = points.shape[1:] == (2,), homogeneous.shape[2:] == (3,), rays.numel() in (0, 4)
    if not all(sizes):
        raise ValueError("points, curves or rays have wrong shapes")
    if any(t.dtype != torch.float64 for t in (points, homogeneous, rays)):
        raise TypeError("points, curves and rays must be float64")
    points, homogeneous, rays = (t.contiguous() for t in (points, homogeneous, rays))
    tau, normal = points.new_empty(len(points)), torch.empty_like(points)
    core.closest_on_curves(
        homogeneous=homogeneous.data_ptr(),
        num_curves=len(homogeneous),
        degree=homogeneous.shape[1] - 1,
        closed=closed,
        size=size,
        rays=rays.data_ptr() if rays.numel() else 0,
        points=points.data_ptr(),
        num_points=len(points),
        tau=tau.data_ptr(),
        normal=normal.data_ptr(),
    )
    return tau, normal


@closest_on_curves.register_fake
def _(
    points: Tensor, homogeneous: Tensor, rays: Tensor, closed: bool, size: float
) -> tuple[Tensor, Tensor]:
    return points.new_empty(len(points)), torch.empty_like(points)


closest_on_curves_layer = make_first_order(closest_on_curves)
