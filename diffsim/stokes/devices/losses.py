"""Features of the flow at outlets, and losses on them (thesis 4.2.6, eq. 4.76)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require, require_choice
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid

_ANGLE_EPS = 1e-3  # |angle| is rounded off below this [rad]


def on_face(grid: Grid, nodal: Tensor, face: str) -> Tensor:
    """Entries on a face of the box: nodal (cases, *node_shape, ...) -> (cases, *face, ...)."""
    axis, side = grid.face_axis(face)
    return nodal.select(1 + axis, grid.shape[axis] if side else 0)


@checked
def integral(field: FlowField, face: str, values: Tensor) -> Tensor:
    """Integral over the fluid part of a face.

    Args:
        face: "x-", "x+", ...
        values: Values at the face's nodes, (cases, *face_node_shape); multilinear between them.

    Returns:
        (cases,) [value m^(dim-1)]. Gradient: values and phi.
    """
    grid = field.grid
    axis, side = grid.face_axis(face)
    of_face = (*grid.node_shape[:axis], *grid.node_shape[axis + 1 :])
    values = require("values", values, ("cases", *of_face), finite=False)
    nodal = values.new_zeros(len(values), *grid.node_shape)
    normal = nodal.select_scatter(values, 1 + axis, grid.shape[axis] if side else 0)
    carrier = nodal.new_zeros(*nodal.shape, grid.dim).select_scatter(normal, -1, axis)
    return dataclasses.replace(field, velocity=carrier).flux(axis, -side)


@checked
def area(field: FlowField, faces: Sequence[str]) -> Tensor:
    """Fluid area of faces, scalar [m^(dim-1)]; refuses closed ones."""
    return _integrals_and_area(field, faces, field.phi.new_zeros(0, *field.grid.node_shape))[-1]


@checked
def mean(field: FlowField, faces: Sequence[str], nodal: Tensor) -> Tensor:
    """Average over the fluid part of faces: nodal (cases, *node_shape) -> (cases,)."""
    nodal = require("nodal", nodal, ("cases", *field.grid.node_shape), finite=False)
    both = _integrals_and_area(field, faces, nodal)
    return both[:-1] / both[-1]


def _integrals_and_area(field: FlowField, faces: Sequence[str], nodal: Tensor) -> Tensor:
    """Integrals of nodal (cases, *node_shape) over faces, and their area, (cases + 1,)."""
    grid, total = field.grid, nodal.new_zeros(len(nodal) + 1)
    for face in faces:
        values = on_face(grid, nodal, face)
        ones = values.new_ones(1, *values.shape[1:])
        total = total + integral(field, face, torch.cat([values, ones]))
    if anywhere(~(total[-1] > 0)):
        raise ValueError(f"no fluid at the outlets {list(faces)}: the design closes them")
    return total


@checked
def squared_difference(field: FlowField, faces: Sequence[str], target: Tensor) -> Tensor:
    """Average of |v - target|^2 over the outlets and cases, scalar [m^2/s^2].

    Args:
        target: Wanted velocity [m/s], broadcast against (cases, *node_shape, dim).
    """
    return mean(field, faces, ((field.velocity - target) ** 2).sum(-1)).mean()


@checked
def mean_velocity(field: FlowField, faces: Sequence[str], region: Tensor | None = None) -> Tensor:
    """Average velocity over the fluid part of faces, (cases, dim) [m/s].

    Args:
        field: The flow.
        faces: Faces of the box that are outlets.
        region: Nodes that count, (*node_shape,) bool, to look at one of several outlets of a face;
            its border should lie in the solid.
    """
    weight = torch.ones_like(field.phi)
    if region is not None:
        kept = require("region", region, field.grid.node_shape, torch.bool)
        weight = kept.to(field.phi.dtype)
    share = mean(field, faces, weight[None])
    if anywhere(~(share > 0)):
        raise ValueError(f"no fluid at an outlet on {list(faces)}: the design closes it")
    parts = [mean(field, faces, weight * field.velocity[..., a]) for a in range(field.grid.dim)]
    return torch.stack(parts, -1) / share[:, None]


@checked
def angle_difference(field: FlowField, faces: Sequence[str], angle: float) -> Tensor:
    """Average over outlets and cases of |angle of (u, v) - angle|, scalar [rad].

    The absolute value is rounded off below 1e-3 rad.
    """
    cos, sin = torch.cos(torch.tensor(angle)).double(), torch.sin(torch.tensor(angle)).double()
    u, v = field.velocity[..., 0], field.velocity[..., 1]
    along, across = cos * u + sin * v, cos * v - sin * u
    moving = along.detach() ** 2 + across.detach() ** 2 > 1e-24
    turned = torch.atan2(across, torch.where(moving, along, torch.ones_like(along)))
    size = torch.sqrt(turned**2 + _ANGLE_EPS**2) - _ANGLE_EPS
    return mean(field, faces, torch.where(moving, size, torch.zeros_like(size))).mean()


@checked
def vertical_curl(field: FlowField, face: str) -> Tensor:
    """d v/dx - d u/dy at the centers of the cells of a horizontal face, (cases, nx, ny) [1/s]."""
    grid = field.grid
    require_choice("face", face, [f for f in grid.faces if f.startswith("z")])
    velocity = on_face(grid, field.velocity, face)
    u, v = velocity[..., 0], velocity[..., 1]
    dv = (v[:, 1:] - v[:, :-1]) / grid.spacing[0]
    du = (u[:, :, 1:] - u[:, :, :-1]) / grid.spacing[1]
    return 0.5 * (dv[:, :, 1:] + dv[:, :, :-1]) - 0.5 * (du[:, 1:] + du[:, :-1])
