"""Fields on a grid: their values and slopes at points and just beyond walls, means, integrals."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from diffsim.core.arrays import Array
from diffsim.stokes import FlowField, Grid
from diffsim.stokes.devices.losses import integral, on_face

DEEP = 0.75
"""Pressures of cut cells are poor: pressures are fitted to cells so many spacings from the wall."""

NUM_NEIGHBORS = 12
"""The stencil of a node inside: its 4 cells and the 8 around them."""


class MovingFit:
    """Moving least squares: at every target a linear function fitted to the nearest sources.

    Exact for linear fields, also outside of the sources' hull, as at the solid corner of a cut
    cell; second order where the stencil is symmetric.

    Args:
        sources: Points with known values, (num_sources, 2) [m].
        targets: Points at which the fit is evaluated, (num_targets, 2) [m].
        spacing: Cell size [m], width of the weights.

    Attributes:
        value, slope: Sparse (num_targets, num_sources) matrices: the value [-] and, along x and y,
            the slope [1/m].
    """

    def __init__(self, sources: Array, targets: Array, spacing: float):
        if len(sources) < NUM_NEIGHBORS:
            raise ValueError(f"{len(sources)} fluid cells are too few, need {NUM_NEIGHBORS}")
        distance, nearest = cKDTree(sources).query(targets, k=NUM_NEIGHBORS)
        arms = (sources[nearest] - targets[:, None]) / spacing
        basis = np.concatenate([np.ones((*arms.shape[:2], 1)), arms], -1)
        root = np.exp(-0.25 * (distance / spacing) ** 2)[..., None]
        fit = np.linalg.pinv(root * basis) * root[..., 0][:, None]  # (targets, 3, neighbors)
        rows = np.repeat(np.arange(len(targets)), NUM_NEIGHBORS)
        index = torch.from_numpy(np.stack([rows, nearest.reshape(-1)]))
        size = (len(targets), len(sources))

        def matrix(weights: Array) -> Tensor:
            flat = torch.from_numpy(np.ascontiguousarray(weights).reshape(-1))
            return torch.sparse_coo_tensor(index, flat, size, check_invariants=False).coalesce()

        self.value = matrix(fit[:, 0])
        self.slope = tuple(matrix(fit[:, 1 + axis] / spacing) for axis in range(2))

    def at(self, field: Tensor) -> Tensor:
        """Values (..., num_sources) -> (..., num_targets)."""
        return apply(self.value, field)

    def along(self, axis: int, field: Tensor) -> Tensor:
        """Slopes along an axis, (..., num_sources) -> (..., num_targets)."""
        return apply(self.slope[axis], field)


def apply(matrix: Tensor, field: Tensor) -> Tensor:
    """A sparse matrix times the last axis of a field."""
    flat = field.reshape(-1, field.shape[-1])
    return torch.sparse.mm(matrix, flat.T).T.reshape(*field.shape[:-1], matrix.shape[0])


def average_corners(nodal: Tensor) -> Tensor:
    """Means over the corners of cells, (nx, ny), of values at nodes (nx + 1, ny + 1)."""
    return 0.25 * (nodal[1:, 1:] + nodal[:-1, 1:] + nodal[1:, :-1] + nodal[:-1, :-1])


def integrate_face(grid: Grid, phi: Tensor, along_x: Tensor, face: str) -> Tensor:
    """Integral of nodal values (cases, *node_shape) over the fluid part of a face, (cases,).

    Args:
        phi: Level set at the nodes, positive in the fluid.
        face: Face of the box, such as "x-".
    """
    empty = phi.new_zeros(0)
    still = phi.new_zeros(0, *grid.node_shape, grid.dim)
    field = FlowField(grid, phi, still, empty, empty, {})
    return integral(field, face, on_face(grid, along_x, face))
