"""Fluidic switch: turning an obstacle sends the flow the other way (thesis fig. 4-25)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.stokes.boundary import Inlet, Open, Wall
from diffsim.stokes.devices.column import NUM_AROUND, column
from diffsim.stokes.devices.device import (
    SOLVER,
    Device,
    Parameter,
    State,
    between,
    points2d,
    scaled,
)
from diffsim.stokes.devices.losses import squared_difference
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import BezierCurve2d, Extrude, Rotate, Shape

_HEIGHT, _PIN = 0.5, (0.6, 0.5)  # of the box; where the obstacle is pinned [m]
_RINGS = 3
_INLET = (0.3, 0.7)
_UPPER = [(0.0, 0.7), (0.1, 0.7), (0.75, 0.9), (1.0, 0.9)]
_RIGHT = [(1.0, 0.65), (0.9, 0.6), (0.9, 0.4), (1.0, 0.35)]
_OUTLET = 0.25  # width of each [m]


@checked
def switch(resolution: float = 1.0, *, profile: str = "paths") -> Device:
    """The fluidic switch: 64 x 64 x 32 cells, 24 control points and two angles, no-slip walls.

    One inlet on the left, two outlets on the right, y > 0.65 and y < 0.35 m; between them an
    obstacle, radii of three rings of eight control points, that turns about a vertical axis. The
    loss is the sum over both positions of the average of |v - target|^2 over the outlets.

    Args:
        resolution: Factor on the number of cells per axis.
        profile: Target. "paths": in the first position all flow leaves evenly through the upper
            outlet and none through the lower one, in the second the other way round (the thesis's
            figure). "crossed": the inlet's speed in the lower half of one outlet and in the upper
            half of the other, exchanged by turning (the published code).
    """
    require_choice("profile", profile, ("paths", "crossed"))
    grid = Grid(scaled((64, 64, 32), resolution), size=(1.0, 1.0, _HEIGHT))
    conditions: list[Inlet | Open | Wall] = [
        Inlet("x-", "inlet", between(grid, 1, *_INLET)),
        Open("x+"),
        Wall("z-", "slip"),
        Wall("z+", "slip"),
    ]
    upper, low = grid.nodes[..., 1] > 0.5, grid.nodes[..., 2] <= 0.5 * _HEIGHT
    if profile == "paths":
        speed, on = (_INLET[1] - _INLET[0]) / _OUTLET, upper
    else:
        speed, on = 1.0, upper != low
    inlet = {"inlet": torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64)}
    along = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    band = 4.0 * max(grid.spacing)
    states = tuple(
        State(name, _build_turned_shape(24 + k, band), inlet, _towards(mask[..., None] * along))
        for k, (name, mask) in enumerate((("on", on), ("off", ~on)))
    )
    radii = [
        Parameter(f"radius of ring {i + 1} at {360 // NUM_AROUND * k} degrees", 0.08, 0.32)
        for i in range(_RINGS)
        for k in range(NUM_AROUND)
    ]
    angles = [
        Parameter("angle on", -math.pi / 4.0, math.pi / 4.0),
        Parameter("angle off", -3.0 * math.pi / 4.0, -math.pi / 4.0),
    ]
    return Device(
        name="switch",
        flow=StokesFlow(grid, conditions, wall="no_slip", solver=SOLVER),
        parameters=(*radii, *angles),
        states=states,
        num_samples=100,
        reference={"loss": 5.8e-1, "seconds": 171.1},
        options={"resolution": resolution, "profile": profile},
    )


def _towards(target: Tensor) -> Callable[[FlowField], Tensor]:
    return lambda field: squared_difference(field, ["x+"], target)


def _build_turned_shape(angle: int, band: float) -> Callable[[Tensor], Shape]:
    """Walls and obstacle; the obstacle's angle is x[angle]."""

    def shape(x: Tensor) -> Shape:
        upper, right = points2d(_UPPER, x), points2d(_RIGHT, x)
        lower = upper * torch.tensor([1.0, -1.0]) + torch.tensor([0.0, 1.0])
        outline = (
            BezierCurve2d(upper, fluid="right")
            & BezierCurve2d(lower, fluid="left")
            & BezierCurve2d(right, fluid="right")
        )
        radii = x[:24].reshape(_RINGS, NUM_AROUND)
        heights = tuple(_HEIGHT * k / (_RINGS - 1) for k in range(_RINGS))
        obstacle = column(radii, heights, _PIN, fluid="outside", degree=2, band=band)
        return Extrude(outline) & Rotate(obstacle, x[angle], center=(*_PIN, 0.0))

    return shape
