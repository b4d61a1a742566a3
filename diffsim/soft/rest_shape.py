"""A rest shape in place of the mesh's, as kernels take it and with its gradient.

What kernels know of a shape are its *tables*: the shape gradients and weights of all elements, and
the directions of the fibers, which are drawn on the material and turn with it. They are parameters
as a stiffness is (csrc/kernels/soft/shape_derivatives.h); how they follow from the positions is
said in PyTorch's own operations, once for both modes of differentiation. So is how the stiffness of
a tendon's pieces follows, which is of their lengths and of the volumes around them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.core.errors import MeshError
from diffsim.core.numbers import values_of
from diffsim.core.torch_names import on_constants
from diffsim.mesh import HexMesh, TetMesh
from diffsim.mesh.shape import lump, nodal_shares, shape_tables
from diffsim.mesh.split import join_eighths
from diffsim.soft.elements import moved_tables
from diffsim.soft.muscles import MuscleSet


class RestShape(NamedTuple):
    """A rest shape and what follows from it."""

    x_rest: Tensor  # positions, (num_nodes, 3) [m]
    shares: Tensor  # volume of each element lumped to its nodes, (num_elements, 8 or 4) [m^3]
    nodal: Tensor  # volume of each node, (num_nodes,) [m^3]
    # of all elements, then the directions of all fibers, (num_tables,); empty: those of the mesh
    tables: Tensor
    # of all fibers in place of their own, (num_fibers,), see ``Muscle``; None: those
    fiber_weights: Tensor | None


def moved_shape(
    mesh: HexMesh | TetMesh, element: str, muscles: MuscleSet, x_rest: Tensor
) -> RestShape:
    """The shape of a mesh whose nodes lie at x_rest, (num_nodes, 3) [m]. Gradient: x_rest.

    Raises:
        MeshError: an element is turned inside out, or midpoints of quadratic elements are not in
            the middle.
    """
    x_rest = require("x_rest", x_rest, (mesh.num_nodes, 3))
    if not torch.compiler.is_compiling():
        with on_constants():
            _require_upright(mesh, element, values_of(x_rest))
    tables = moved_tables(mesh, element, x_rest)
    shares = nodal_shares(mesh, x_rest)
    directions, fiber_weights = _carried_fibers(mesh, muscles, x_rest, shares)
    return RestShape(
        x_rest=x_rest,
        shares=shares,
        nodal=lump(mesh, shares),
        tables=torch.cat([tables.by_element().flatten(), directions.flatten()]),
        fiber_weights=fiber_weights,
    )


def _carried_fibers(
    mesh: HexMesh | TetMesh, muscles: MuscleSet, x_rest: Tensor, shares: Tensor
) -> tuple[Tensor, Tensor | None]:
    """Fibers that the deformation from the mesh to x_rest carries along.

    Returns:
        Directions by the mean deformation of their elements, (num_fibers, 3), and weights,
        (num_fibers,): those of cables by length over volume. None where there are no cables.
    """
    if not len(muscles.elements):
        return muscles.directions, None
    with on_constants():
        grad, weight = shape_tables(mesh, mesh.x_rest, muscles.elements)
        along = torch.einsum("fqai,fi->fqa", grad, muscles.directions)
        volume = weight.sum(1)
        share = weight / volume[:, None]
    lines = torch.einsum("fqa,fai->fqi", along, x_rest[mesh.elements[muscles.elements]])
    carried = torch.einsum("fq,fqi->fi", share, lines)
    directions = carried / carried.norm(dim=1, keepdim=True)
    if not muscles.has_cables:
        return directions, None
    longer = (share * lines.norm(dim=2)).sum(1)  # as Tendon.stretch has it
    larger = shares.sum(1)[muscles.elements] / volume
    return directions, torch.where(
        muscles.is_cable, muscles.weights * longer / larger, muscles.weights
    )


def _require_upright(mesh: HexMesh | TetMesh, element: str, x_rest: Tensor) -> None:
    """Refuse what is no mesh, by the checks of one."""
    for items in x_rest.reshape(-1, *x_rest.shape[-2:]):
        try:
            moved = type(mesh)(items, mesh.elements)
            if element == "quadratic" and isinstance(moved, TetMesh):
                join_eighths(moved)
        except MeshError as err:
            raise MeshError(f"x_rest makes no mesh: {err}", err.indices) from err
