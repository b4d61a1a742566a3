"""Superposition gate: the outlet flow is the vector sum of the inlets' (thesis fig. 4-22)."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.checked import checked
from diffsim.stokes.devices.corner import CASES, OUTLETS, conditions, inputs, walls
from diffsim.stokes.devices.device import Device, Parameter, State, scaled
from diffsim.stokes.devices.losses import squared_difference
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import Shape


@checked
def gate(resolution: float = 1.0) -> Device:
    """The superposition gate: 64 x 64 x 4 cells, five parameters, walls without separation.

    Inflow (v1, 0, 0) from the left and (0, v2, 0) from below shall leave at the opposite corner as
    (v1, v2, 0). The design is symmetric about the diagonal. Loss: average of |v - target|^2 over
    the outlet and the inputs (1, 0) and (0, 1).

    Args:
        resolution: Factor on the number of cells per axis.
    """
    grid = Grid(scaled((64, 64, 4), resolution), size=(1.0, 1.0, 4.0 / 64.0))
    target = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    target = target[:, None, None, None]

    def loss(field: FlowField) -> Tensor:
        return squared_difference(field, OUTLETS, target)

    bounds = [
        ("near corner, along", 0.01, 0.39),
        ("outer walls, first point", 0.01, 0.59),
        ("outer walls, second point, along", 0.59, 0.99),
        ("outer walls, second point, across", 0.01, 0.99),
        ("near corner, across", 0.01, 0.59),
    ]
    return Device(
        name="gate",
        flow=StokesFlow(grid, conditions(grid), wall="no_separation"),
        parameters=tuple(Parameter(*b) for b in bounds),
        states=(State("gate", _walls, inputs(), loss),),
        num_samples=10,
        cases=CASES,
        directions=((1.0, 0.0), (0.0, 1.0)),
        reference={"loss": 4.9e-1, "seconds": 4.9},
        options={"resolution": resolution},
    )


def _walls(x: Tensor) -> Shape:
    a, b, c, d, e = x.unbind()
    return walls(torch.stack([a, e, e, a, b, c, d, b, d, c]))
