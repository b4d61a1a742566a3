"""Values at the nodes of a grid, averaged over its cells and integrated over its faces."""

from __future__ import annotations

from torch import Tensor

from diffsim.stokes import FlowField, Grid
from diffsim.stokes.devices.losses import integral, on_face


def average_corners(nodal: Tensor) -> Tensor:
    """Means over the corners of cells, (nx, ny), of values at nodes (nx + 1, ny + 1)."""
    return 0.25 * (nodal[1:, 1:] + nodal[:-1, 1:] + nodal[1:, :-1] + nodal[:-1, :-1])


def integrate_face(grid: Grid, phi: Tensor, along_x: Tensor, face: str) -> Tensor:
    """Integral of nodal values (cases, *node_shape) over the fluid part of a face, (cases,).

    Args:
        grid: Grid of the values.
        phi: Level set at the nodes, positive in the fluid.
        along_x: The values.
        face: Face of the box, such as "x-".
    """
    empty = phi.new_zeros(0)
    field = FlowField(grid, phi, along_x[..., None], empty, empty, {})
    return integral(field, face, on_face(grid, along_x, face))
