"""Spline surfaces around a vertical axis, their control points at eight angles."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.stokes.shapes import NurbsSurface

NUM_AROUND = 8
# a periodic cubic spline of eight points at radius r has radius r (2 + cos 45 degrees) / 3
_SHRINK = (2.0 + math.cos(math.pi / 4.0)) / 3.0


def column(
    radii: Tensor,
    heights: tuple[float, ...],
    center: tuple[float, float],
    *,
    fluid: str,
    degree: int,
    band: float,
) -> NurbsSurface:
    """A column from radii (num_heights, 8) [m]; equal radii give a circle of that radius.

    Args:
        radii: Radii of rings of control points at angles k x 45 degrees.
        heights: Heights of the rings [m], rising.
        center: x, y of the axis [m].
        fluid: "inside" or "outside".
        degree: Along the axis; cubic around it.
        band: Distance within which phi is exact [m].
    """
    angle = 2.0 * math.pi / NUM_AROUND * torch.arange(NUM_AROUND, dtype=torch.float64)
    x = center[0] + radii / _SHRINK * torch.cos(angle)
    y = center[1] + radii / _SHRINK * torch.sin(angle)
    z = torch.tensor(heights, dtype=torch.float64)[:, None].expand(len(heights), NUM_AROUND)
    points = torch.stack([x, y, z], -1).transpose(0, 1).contiguous()
    return NurbsSurface(points, fluid=fluid, degree=(3, degree), band=band)
