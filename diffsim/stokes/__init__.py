"""Stokes flow on Cartesian grids with embedded boundaries, differentiable in the shape."""

from diffsim.stokes.boundary import Boundary, Inlet, Open, Wall
from diffsim.stokes.cells import CutCells, cut_cells
from diffsim.stokes.field import FlowField
from diffsim.stokes.flow import StokesFlow
from diffsim.stokes.grid import Grid
from diffsim.stokes.options import SolverOptions

__all__ = [
    "Boundary",
    "CutCells",
    "FlowField",
    "Grid",
    "Inlet",
    "Open",
    "SolverOptions",
    "StokesFlow",
    "Wall",
    "cut_cells",
]
