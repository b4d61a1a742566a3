"""What funnel and superposition gate share: inlets left and below, an outlet at the far corner."""

from __future__ import annotations

from torch import Tensor

from diffsim.stokes.boundary import Inlet, Open, Wall
from diffsim.stokes.devices.device import basis_inputs, between, points2d
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import BezierCurve2d, Extrude, Shape

_IN = (0.4, 0.6)  # inlets on x = 0 and y = 0 [m]
_OUT = 0.8  # the outlet: beyond this on x = 1 and y = 1 [m]

OUTLETS = ("x+", "y+")
CASES = ("inlet on the left", "inlet below")


def conditions(grid: Grid) -> list[Inlet | Open | Wall]:
    """Inlets "left" and "below", open corner, top and bottom without friction."""
    return [
        Inlet("x-", "left", between(grid, 1, *_IN)),
        Inlet("y-", "below", between(grid, 0, *_IN)),
        Open("x+"),
        Open("y+"),
        Wall("z-", "slip"),
        Wall("z+", "slip"),
    ]


def inputs() -> dict[str, Tensor]:
    """Two cases: (1, 0) and (0, 1)."""
    return basis_inputs("left", "below", directions=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])


def walls(x: Tensor) -> Shape:
    """Three curves from ten numbers.

    The corner between the inlets (x0, x1), (x2, x3); below the outlet x4 (height of the first
    point) and (x5, x6); above it x7 and (x8, x9).
    """
    near = points2d([(0.0, _IN[0]), (x[0], x[1]), (x[2], x[3]), (_IN[0], 0.0)], x)
    right = points2d([(_IN[1], 0.0), (_IN[1], x[4]), (x[5], x[6]), (1.0, _OUT)], x)
    upper = points2d([(0.0, _IN[1]), (x[7], _IN[1]), (x[8], x[9]), (_OUT, 1.0)], x)
    outline = (
        BezierCurve2d(near, fluid="left")
        & BezierCurve2d(right, fluid="left")
        & BezierCurve2d(upper, fluid="right")
    )
    return Extrude(outline)
