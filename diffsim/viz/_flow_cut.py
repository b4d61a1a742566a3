"""2D flows, and planes through 3D flows, sampled finely for drawing."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from diffsim.stokes.field import FlowField

Plane = tuple[str, float]
FINE = 4
"""Drawn samples per cell and axis: the multilinear field, not its corners."""


class Cut:
    """A 2D flow, or a plane of a 3D one, sampled finely for drawing."""

    def __init__(
        self, field: FlowField, case: int, axes: list[int], fixed: float | None, name: str
    ):
        grid = field.grid
        self.name, self.axes = name, axes
        self.scale, self.unit = length_unit(field)
        starts = [grid.origin[a] for a in axes]
        self.sides = [grid.size[a] for a in axes]
        self.cells = [grid.shape[a] for a in axes]
        # middles of small pixels: nothing is sampled on the box's faces
        line = [o + s * (np.arange(FINE * n) + 0.5) / (FINE * n)
                for o, s, n in zip(starts, self.sides, self.cells, strict=True)]  # fmt: skip
        self.x, self.y = line
        self.extent: Any = [
            self.scale * e for o, s in zip(starts, self.sides, strict=True) for e in (o, o + s)
        ]
        points = np.zeros((len(self.x), len(self.y), grid.dim))
        points[..., axes[0]], points[..., axes[1]] = self.x[:, None], self.y[None]
        if fixed is not None:
            points[..., 3 - sum(axes)] = fixed
        flat = torch.from_numpy(points.reshape(-1, grid.dim))
        with torch.no_grad():
            v = field.sample(flat)[case].numpy()
            phi = _level(field).sample(flat)[0, :, 0].numpy()
        self.phi = phi.reshape(points.shape[:2])
        self.velocity = v.reshape(points.shape)
        self.speed = np.where(self.phi > 0, np.linalg.norm(self.velocity, axis=-1), np.nan)
        self.top_speed = float(np.nanmax(self.speed)) if bool((self.phi > 0).any()) else 0.0


def cut_through(field: FlowField, case: int, plane: Plane | None) -> Cut:
    cases = len(field.velocity)
    if not 0 <= case < cases:
        raise ValueError(f"case must lie in [0, {cases}), got {case}")
    if field.grid.dim == 2:
        return Cut(field, case, [0, 1], None, "")
    name, share = plane or ("z", 0.5)
    if name not in ("x", "y", "z") or not 0.0 <= share <= 1.0:
        raise ValueError(f"plane must be an axis and a share in [0, 1], got {(name, share)}")
    axis = "xyz".index(name)
    at = field.grid.origin[axis] + share * field.grid.size[axis]
    scale, unit = length_unit(field)
    axes = [a for a in range(3) if a != axis]
    return Cut(field, case, axes, at, f"{name} = {scale * at:.3g} {unit}")


def _level(field: FlowField) -> FlowField:
    """The level set as the only component of a velocity, to be sampled like one."""
    phi = field.phi.detach()
    values = phi[None, ..., None].expand(1, *phi.shape, field.grid.dim).contiguous()
    return FlowField(field.grid, phi, values, field.pressure, field.volume_fraction, {})


def length_unit(field: FlowField) -> tuple[float, str]:
    size = max(field.grid.size)
    return (1e6, "um") if size < 1e-4 else (1e3, "mm") if size < 0.5 else (1.0, "m")
