"""Level sets at the nodes of grids."""

from __future__ import annotations

from torch import Tensor

from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere
from diffsim.stokes.shapes.base import LevelSet, as_shape


@checked
def sample(shape: LevelSet, nodes: Tensor) -> Tensor:
    """phi of a shape at grid nodes: > 0 in the fluid, < 0 in the solid.

    Args:
        shape: Level set, or a callable as in ``Custom``.
        nodes: Positions of the nodes, (..., d) float64 [m].

    Returns:
        phi (...) [m]. Gradients: the shape's parameters and the nodes.

    Raises:
        ValueError: NaN; or no node in the fluid.
    """
    phi = as_shape("shape", shape)(nodes)
    if phi.numel() and not anywhere(phi > 0):
        raise ValueError(
            "the grid is solid everywhere (phi < 0 is solid); check the fluid's side, or use "
            "Complement"
        )
    return phi
