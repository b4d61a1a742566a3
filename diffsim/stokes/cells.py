"""Cells cut by the planes that fit a level set."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require, require_threads
from diffsim.core.checked import checked
from diffsim.stokes import _ops_cut
from diffsim.stokes.grid import Grid


class CutCells(NamedTuple):
    """Volume (*cells,) [m^dim], area (*cells,) [m^(dim-1)], normal (*cells, dim) of every cell."""

    volume: Tensor
    area: Tensor
    normal: Tensor


@checked
def cut_cells(grid: Grid, phi: Tensor, *, num_threads: int = 1) -> CutCells:
    """Fluid volume, interface area and normal of every cell, exact for planes.

    In each cell the level set is replaced by the plane that fits its corner values best (least
    squares), or, in 2D, by the chord between the places where the wall crosses the cell's edges; as
    ``StokesFlow`` does. Volume and area are then those of a half space in a box,
    also where components of the normal vanish. A plane in a cell's face belongs to the cell on its
    fluid side.

    Args:
        grid: The grid.
        phi: Level set at the nodes, (*node_shape,) float64, > 0 in the fluid [any unit].
        num_threads: Worker threads.

    Returns:
        ``CutCells``; the normal points out of the fluid and is zero in cells without interface.
        Gradient: phi, first order. The area of a cell jumps where a plane parallel to a face passes
        it, and in 2D has a kink where the line passes a corner.

    Reference: thesis eqs. 4.72, 4.74 (the same numbers where those are defined).
    """
    phi = require("phi", phi, grid.node_shape, torch.float64)
    volume, area, normal = _ops_cut.cut_cells(
        phi=phi.reshape(-1),
        cells=list(grid.shape),
        spacing=list(grid.spacing),
        num_threads=require_threads(num_threads),
    )
    return CutCells(
        volume.reshape(grid.shape), area.reshape(grid.shape), normal.reshape(*grid.shape, grid.dim)
    )
