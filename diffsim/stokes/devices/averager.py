"""Flow averager: two inlets in, their average out of both outlets (thesis fig. 4-22, top)."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.stokes.boundary import Inlet, Open, Wall
from diffsim.stokes.devices.device import (
    Device,
    Parameter,
    State,
    basis_inputs,
    between,
    points2d,
    scaled,
)
from diffsim.stokes.devices.losses import mean_velocity, squared_difference
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import BezierCurve2d, Extrude, Shape

_LOW, _HIGH = 0.1, 0.4  # lower passage [m]; the upper one is its mirror image


@checked
def averager(resolution: float = 1.0, *, objective: str = "pointwise") -> Device:
    """The flow averager: 64 x 64 x 4 cells, eight parameters, walls without separation.

    Passages 0.3 m wide enter on the left and leave on the right of a box 1 m wide; four Bezier
    curves, symmetric about the middle, bound them from below, from above and by an island on
    either side. Outlets are as wide as inlets, so that a perfect device may exist (the thesis does
    not give its coordinates).

    Args:
        resolution: Factor on the number of cells per axis.
        objective: Loss over both outlets and inputs (1, 0) and (0, 1): "pointwise", average of
            |v - (1/2, 0, 0)|^2; or "average", that of each outlet's average velocity.
    """
    require_choice("objective", objective, ("pointwise", "average"))
    grid = Grid(scaled((64, 64, 4), resolution), size=(1.0, 1.0, 4.0 / 64.0))
    conditions: list[Inlet | Open | Wall] = [
        Inlet("x-", "lower", between(grid, 1, _LOW, _HIGH)),
        Inlet("x-", "upper", between(grid, 1, 1.0 - _HIGH, 1.0 - _LOW)),
        Open("x+"),
        Wall("z-", "slip"),
        Wall("z+", "slip"),
    ]
    target = torch.tensor([0.5, 0.0, 0.0], dtype=torch.float64)
    lower_half = grid.nodes[..., 1] < 0.5

    def loss(field: FlowField) -> Tensor:
        if objective == "pointwise":
            return squared_difference(field, ["x+"], target)
        means = [mean_velocity(field, ["x+"], half) for half in (lower_half, ~lower_half)]
        return ((torch.stack(means) - target) ** 2).sum(-1).mean()

    inlet = basis_inputs("lower", "upper", directions=[(1.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    bounds = [
        ("outer walls, first point, x", 0.01, 0.49),
        ("outer walls, first point, y", 0.01, 0.49),
        ("outer walls, second point, x", 0.49, 0.99),
        ("outer walls, second point, y", 0.01, 0.49),
        ("right island, x", 0.49, 0.99),
        ("right island, y", 0.01, 0.49),
        ("left island, x", 0.01, 0.49),
        ("left island, y", 0.01, 0.49),
    ]
    return Device(
        name="averager",
        flow=StokesFlow(grid, conditions, wall="no_separation"),
        parameters=tuple(Parameter(*b) for b in bounds),
        states=(State("averager", _walls, inlet, loss),),
        num_samples=10,
        cases=("lower inlet", "upper inlet"),
        reference={"loss": 3.1e-2, "seconds": 5.3},
        options={"resolution": resolution, "objective": objective},
    )


def _walls(x: Tensor) -> Shape:
    mirror = torch.tensor([1.0, -1.0], dtype=torch.float64)
    up = torch.tensor([0.0, 1.0], dtype=torch.float64)
    low = points2d([(0.0, _LOW), (x[0], x[1]), (x[2], x[3]), (1.0, _LOW)], x)
    outline = (
        BezierCurve2d(low, fluid="left")
        & BezierCurve2d(low * mirror + up, fluid="right")
        & _island(1.0, 1.3, x[4], x[5])
        & _island(0.0, -0.3, x[6], x[7])
    )
    return Extrude(outline)


def _island(side: float, beyond: float, x: Tensor, y: Tensor) -> Shape:
    """Between the passages at x = side; the loop is closed beyond the box."""
    loop: list[tuple[float | Tensor, float | Tensor]] = [
        (side, _HIGH),
        (x, y),
        (x, 1.0 - y),
        (side, 1.0 - _HIGH),
        (beyond, 1.0 - _HIGH),
        (beyond, _HIGH),
    ]
    return BezierCurve2d(points2d(loop, x), degree=3, closed=True, fluid="outside")
