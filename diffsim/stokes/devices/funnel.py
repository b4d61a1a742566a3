"""Funnel: whatever the inlets do, the flow leaves at 45 degrees (thesis fig. 4-22, middle)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.stokes.devices.corner import CASES, OUTLETS, conditions, inputs, walls
from diffsim.stokes.devices.device import SOLVER, Device, Parameter, State, scaled
from diffsim.stokes.devices.losses import angle_difference
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import Custom, Shape

_HEIGHT = 16.0 / 64.0  # of the box [m]


@checked
def funnel(resolution: float = 1.0, *, bump: float = 0.06) -> Device:
    """The funnel: 64 x 64 x 16 cells, ten parameters, walls without separation.

    Two inlets, left and below, an outlet at the opposite corner, a bumpy bottom plate (the thesis
    does not say what its bumps are: here waves that end at inlets and outlets). Loss: average of
    the angle between the flow and 45 degrees, over the outlet and the inputs (1, 0) and (0, 1).

    Args:
        resolution: Factor on the number of cells per axis.
        bump: Height of the bumps [m]; 0 for a flat plate, below 0.2.
    """
    bump = require_number("bump", bump, at_least=0.0, at_most=0.2)
    grid = Grid(scaled((64, 64, 16), resolution), size=(1.0, 1.0, _HEIGHT))

    def shape(x: Tensor) -> Shape:
        outline = walls(x)
        return outline & Custom(lambda p: _above_plate(p, bump), dim=3) if bump > 0 else outline

    def loss(field: FlowField) -> Tensor:
        return angle_difference(field, OUTLETS, math.pi / 4.0)

    bounds = [
        ("near corner, first point, x", 0.01, 0.59),
        ("near corner, first point, y", 0.01, 0.39),
        ("near corner, second point, x", 0.01, 0.39),
        ("near corner, second point, y", 0.01, 0.59),
        ("right wall, first point, y", 0.01, 0.59),
        ("right wall, second point, x", 0.59, 0.99),
        ("right wall, second point, y", 0.01, 0.99),
        ("upper wall, first point, x", 0.01, 0.59),
        ("upper wall, second point, x", 0.01, 0.99),
        ("upper wall, second point, y", 0.59, 0.99),
    ]
    return Device(
        name="funnel",
        flow=StokesFlow(grid, conditions(grid), wall="no_separation", solver=SOLVER),
        parameters=tuple(Parameter(*b) for b in bounds),
        states=(State("funnel", shape, inputs(), loss),),
        num_samples=10,
        cases=CASES,
        directions=((1.0, 1.0), (1.0, 1.0)),
        reference={"loss": 2.3e-1, "seconds": 64.8},
        options={"resolution": resolution, "bump": bump},
    )


def _above_plate(points: Tensor, bump: float) -> Tensor:
    """Height over z = bump sin^2(3 pi x) sin^2(3 pi y), divided by the slope: near a distance."""
    k = 3.0 * math.pi
    sx, sy = torch.sin(k * points[:, 0]), torch.sin(k * points[:, 1])
    cx, cy = torch.cos(k * points[:, 0]), torch.cos(k * points[:, 1])
    height = bump * sx**2 * sy**2
    slope_x, slope_y = 2.0 * bump * k * sx * cx * sy**2, 2.0 * bump * k * sy * cy * sx**2
    return (points[:, 2] - height) / torch.sqrt(1.0 + slope_x**2 + slope_y**2)
