"""Amplifier: a nozzle from which the flow leaves three times faster (thesis fig. 4-20)."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.stokes.boundary import Inlet, Open
from diffsim.stokes.devices.device import Device, Parameter, State, between, points2d, scaled
from diffsim.stokes.devices.losses import mean_velocity, squared_difference
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import BezierCurve2d, Shape

_WIDTH, _LOW = 64.0 / 48.0, 0.125  # of the box [m]; lower edge of the inlet [m]
_GAIN = 3.0


@checked
def amplifier(resolution: float = 1.0, *, objective: str = "pointwise") -> Device:
    """The amplifier: 64 x 48 cells, five parameters, walls without separation.

    Fluid enters on the left at 1 m/s through 0.75 m of the 1 m high box. Two cubic Bezier curves,
    mirrored, lead it to the right; their two inner control points and the height of the end are
    free. Both losses vanish if the outlet is a third as wide and, for "pointwise", the flow there
    is straight and even.

    Args:
        resolution: Factor on the number of cells per axis.
        objective: "pointwise": average of |v - (3, 0)|^2 over the outlet, what the published code
            minimizes; or "average": |average of v - (3, 0)|^2, what the thesis's text says.
    """
    require_choice("objective", objective, ("pointwise", "average"))
    grid = Grid(scaled((64, 48), resolution), size=(_WIDTH, 1.0))
    inlet = Inlet("x-", "inlet", between(grid, 1, _LOW, 1.0 - _LOW))
    flow = StokesFlow(grid, [inlet, Open("x+")], wall="no_separation")
    target = torch.tensor([_GAIN, 0.0], dtype=torch.float64)

    def loss(field: FlowField) -> Tensor:
        if objective == "average":
            return ((mean_velocity(field, ["x+"]) - target) ** 2).sum()
        return squared_difference(field, ["x+"], target)

    state = State(
        "amplifier", _walls, {"inlet": torch.tensor([[[1.0, 0.0]]], dtype=torch.float64)}, loss
    )
    return Device(
        name="amplifier",
        flow=flow,
        parameters=(
            Parameter("first control point, x", 0.16 * _WIDTH, 0.49 * _WIDTH),
            Parameter("first control point, y", 0.05, 0.49),
            Parameter("second control point, x", 0.49 * _WIDTH, 0.83 * _WIDTH),
            Parameter("second control point, y", 0.05, 0.49),
            Parameter("end, y", 0.05, 0.49),
        ),
        states=(state,),
        num_samples=10,
        reference={"loss": 1.7e-5, "seconds": 0.2},
        options={"resolution": resolution, "objective": objective},
    )


def _walls(x: Tensor) -> Shape:
    low = points2d([(0.0, _LOW), (x[0], x[1]), (x[2], x[3]), (_WIDTH, x[4])], x)
    mirror = torch.tensor([1.0, -1.0], dtype=torch.float64)
    high = low * mirror + torch.tensor([0.0, 1.0], dtype=torch.float64)
    return BezierCurve2d(low, fluid="left") & BezierCurve2d(high, fluid="right")
