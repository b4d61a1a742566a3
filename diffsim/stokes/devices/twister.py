"""Fluidic twister: a tunnel that makes straight flow spin (thesis fig. 4-23)."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.stokes.boundary import WALL_KINDS, Inlet, Open
from diffsim.stokes.devices.column import NUM_AROUND, column
from diffsim.stokes.devices.device import SOLVER, Device, Parameter, State, scaled
from diffsim.stokes.devices.losses import vertical_curl
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.shapes import Shape

_HEIGHT, _RADIUS = 0.5, 0.3  # of the box; of inlet and outlet [m]
_RINGS = 4
_SPEED = 2.0  # at the rim of the outlet [m/s]


@checked
def twister(resolution: float = 1.0, *, wall: str = "no_separation") -> Device:
    """The fluidic twister: 64 x 64 x 32 cells, 32 control points of a spline tunnel.

    Flow (0, 0, -1) m/s enters the round top; at the round bottom it shall spin with
    omega = 2 m/s / 0.3 m. Free are the radii of four rings of eight control points between them.
    Loss: average of (curl_z - 2 omega)^2 over the cells inside the outlet.

    Args:
        resolution: Factor on the number of cells per axis.
        wall: Kind of wall, "no_separation" or "no_slip".
    """
    require_choice("wall", wall, WALL_KINDS)
    grid = Grid(scaled((64, 64, 32), resolution), size=(1.0, 1.0, _HEIGHT))
    h = max(grid.spacing)

    def on_top(points: Tensor) -> Tensor:  # with the corners of all cells that the rim cuts
        return (points[:, :2] - 0.5).norm(dim=1) < _RADIUS + 1.5 * h

    from_axis = (grid.nodes[:, :, 0, :2] - 0.5).norm(dim=-1)
    corners = [
        from_axis[i : i + grid.shape[0], j : j + grid.shape[1]] for i in (0, 1) for j in (0, 1)
    ]
    inside = torch.stack(corners).amax(0) < _RADIUS
    curl = 2.0 * _SPEED / _RADIUS

    def loss(field: FlowField) -> Tensor:
        return ((vertical_curl(field, "z-")[:, inside] - curl) ** 2).mean()

    def shape(x: Tensor) -> Shape:
        rim = torch.full((1, NUM_AROUND), _RADIUS, dtype=torch.float64)
        radii = torch.cat([rim, x.reshape(_RINGS, NUM_AROUND), rim])
        heights = tuple(_HEIGHT * k / (_RINGS + 1) for k in range(_RINGS + 2))
        return column(radii, heights, (0.5, 0.5), fluid="inside", degree=3, band=4.0 * h)

    inlet = {"top": torch.tensor([[[0.0, 0.0, -1.0]]], dtype=torch.float64)}
    parameters = tuple(
        Parameter(f"radius of ring {i + 1} at {360 // NUM_AROUND * k} degrees", 0.1, 0.4)
        for i in range(_RINGS)
        for k in range(NUM_AROUND)
    )
    slip = wall == "no_separation"
    return Device(
        name="twister",
        flow=StokesFlow(grid, [Inlet("z+", "top", on_top), Open("z-")], wall=wall, solver=SOLVER),
        parameters=parameters,
        states=(State("twister", shape, inlet, loss),),
        num_samples=100,
        slices=(0.75, 0.375, 0.0),
        reference={"loss": 4.9e-2 if slip else 9.7e-1, "seconds": 56.1},
        options={"resolution": resolution, "wall": wall},
    )
