"""Level sets on grids: nodes, and phi there."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require_number
from diffsim.stokes.shapes.base import LevelSet, Vector, as_shape, vector


def grid_nodes(num_cells: Sequence[int], spacing: float, origin: Vector | None = None) -> Tensor:
    """Nodes of a Cartesian grid.

    Args:
        num_cells: Cells along each of 2 or 3 axes.
        spacing: Edge of a cell [m].
        origin: Lowest corner, (d,) [m]; zero if None.

    Returns:
        (num_cells[0] + 1, ..., d) [m], indexed x, y(, z).
    """
    cells = [int(n) for n in num_cells]
    if len(cells) not in (2, 3) or min(cells) < 1:
        raise ValueError(f"num_cells must be 2 or 3 numbers >= 1, got {tuple(num_cells)}")
    h = require_number("spacing", spacing, above=0.0)
    low = vector("origin", [0.0] * len(cells) if origin is None else origin, (len(cells),))
    axes = [h * torch.arange(n + 1, dtype=torch.float64) for n in cells]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1) + low


def sample(shape: LevelSet, nodes: Tensor) -> Tensor:
    """phi of a shape at grid nodes: > 0 in the fluid, < 0 in the solid.

    Args:
        shape: Level set, or a callable as in ``Custom``.
        nodes: Positions of the nodes, (..., d) float64 [m], as from :func:`grid_nodes`.

    Returns:
        phi (...) [m]. Gradients: the shape's parameters and the nodes.

    Raises:
        ValueError: NaN; or no node in the fluid.
    """
    phi = as_shape("shape", shape)(nodes)
    if phi.numel() and not bool((phi.detach() > 0).any()):
        raise ValueError(
            "the grid is solid everywhere (phi < 0 is solid); check the fluid's side, or use "
            "Complement"
        )
    return phi
