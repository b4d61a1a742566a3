"""Shape-function gradients and quadrature weights at rest: what the element kernels read."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.core.checked import checked
from diffsim.core.torch_names import on_constants
from diffsim.mesh.congruence import congruence_classes
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_GAUSS, det3, hex_shape, hex_shape_derivatives

_CHUNK = 1 << 14


@dataclass(frozen=True, eq=False)
class ShapeGradients:
    """Gradients of shape functions with respect to rest positions; F = sum_a x_a grad[., q, a]'.

    Attributes:
        grad: dN_a/dX at the quadrature points, (num_unique, num_quad, num_nodes, 3) [1/m].
        weight: Volume that each quadrature point stands for, (num_unique, num_quad) [m^3].
        class_idx: Row of ``grad`` and ``weight`` that an element uses, (num_elements,) int64.

    Hexahedra: 8 Gauss points in node order 000..111, 8 nodes; elements that are translates of
    each other to 1e-12 of their size share a row. Tetrahedra: one point, one row per element.
    All tensors are contiguous.
    """

    grad: Tensor
    weight: Tensor
    class_idx: Tensor


@checked
@on_constants()
def shape_gradients(mesh: HexMesh | TetMesh) -> ShapeGradients:
    """Shape-function gradients of a mesh at rest.

    Hex: dN/dX = J^-T dN/ds and weight det J / 8 at the 2x2x2 Gauss points, J = dX/ds on [0, 1]^3.
    Tet: constant gradients, weight V.
    """
    elements, class_idx = different_elements(mesh)
    grad, weight = shape_tables(mesh, mesh.x_rest, elements)
    return ShapeGradients(grad.contiguous(), weight.contiguous(), class_idx)


def different_elements(mesh: HexMesh | TetMesh) -> tuple[Tensor, Tensor]:
    """Elements that stand for all others like them, (C,), and which of them each is like, (E,)."""
    if isinstance(mesh, HexMesh):
        found = congruence_classes(mesh.x_rest.numpy(), mesh.hexes.numpy())
        return torch.from_numpy(found[0]), torch.from_numpy(found[1])
    return torch.arange(mesh.num_elements), torch.arange(mesh.num_elements)


def shape_tables(
    mesh: HexMesh | TetMesh, x_rest: Tensor, elements: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Gradients and weights of elements of a mesh whose nodes lie elsewhere.

    Args:
        x_rest: Rest positions, (num_nodes, 3) [m].
        elements: Indices of elements, (C,); None: all.

    Returns:
        (C, num_quad, num_nodes, 3) [1/m] and (C, num_quad) [m^3]. Gradient: x_rest.
    """
    nodes = mesh.elements if elements is None else mesh.elements[elements]
    if isinstance(mesh, HexMesh):
        return hex_gradients(x_rest[nodes])
    grad, weight = tet_gradients(x_rest[nodes])
    return grad[:, None], weight[:, None]


@checked
def nodal_shares(mesh: HexMesh | TetMesh, x_rest: Tensor | None = None) -> Tensor:
    """Volume of each element lumped to its nodes: the integrals of its shape functions.

    Hex: 2x2x2 Gauss, exact for trilinear geometry. Tet: V/4 to each node.

    Args:
        mesh: The mesh.
        x_rest: Rest positions in place of the mesh's, (num_nodes, 3) [m].

    Returns:
        (num_elements, 8 or 4) [m^3], positive, in the order of ``mesh.elements``. Gradient: x_rest.
    """
    if x_rest is None:
        with on_constants():
            shape = shape_gradients(mesh)
            return _shares(mesh, shape.weight)[shape.class_idx]
    x_rest = require("x_rest", x_rest, (mesh.num_nodes, 3))
    return _shares(mesh, shape_tables(mesh, x_rest)[1])


def _shares(mesh: HexMesh | TetMesh, weight: Tensor) -> Tensor:
    if mesh.kind == "hex":
        return weight @ torch.from_numpy(hex_shape(HEX_GAUSS))
    return weight.expand(-1, 4) / 4.0


@checked
def nodal_volume(mesh: HexMesh | TetMesh, x_rest: Tensor | None = None) -> Tensor:
    """Volume lumped to the nodes, see :func:`nodal_shares`.

    Args:
        mesh: The mesh.
        x_rest: Rest positions in place of the mesh's, (num_nodes, 3) [m].

    Returns:
        (num_nodes,) [m^3], positive, summing to the mesh's volume; times density it is the
        lumped mass. Gradient: x_rest.
    """
    return lump(mesh, nodal_shares(mesh, x_rest))


def lump(mesh: HexMesh | TetMesh, shares: Tensor) -> Tensor:
    """Shares of elements (num_elements, 8 or 4) summed at their nodes, (num_nodes,)."""
    none = torch.zeros(mesh.num_nodes, dtype=torch.float64)
    return none.index_add(0, mesh.elements.flatten(), shares.flatten())


def hex_gradients(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients (C, 8, 8, 3) [1/m] and weights (C, 8) [m^3] of hexahedra (C, 8, 3) [m]."""
    derivatives = torch.from_numpy(hex_shape_derivatives(HEX_GAUSS))
    grad, weight = [], []
    for chunk in corners.split(_CHUNK):
        jacobians = torch.einsum("eai,qac->eqic", chunk, derivatives)
        grad.append(derivatives @ _inv3(jacobians))  # (dN/ds)_ac (J^-1)_ci
        weight.append(det3(jacobians) / 8.0)
    return torch.cat(grad), torch.cat(weight)


def tet_gradients(corners: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients (E, 4, 3) [1/m] and volumes (E,) [m^3] of tetrahedra (E, 4, 3) [m]."""
    edges = corners[:, 1:] - corners[:, :1]  # rows x_a - x_0 = J'
    rows = _inv3(edges).transpose(1, 2)  # of J^-1
    return torch.cat([-rows.sum(1, keepdim=True), rows], dim=1), det3(edges) / 6.0


def _inv3(m: Tensor) -> Tensor:
    """Inverses of (..., 3, 3) matrices by cofactors; the caller rules out singular ones."""
    a, b, c = m.unbind(-2)
    cross = torch.linalg.cross
    cofactors = torch.stack([cross(b, c), cross(c, a), cross(a, b)], dim=-1)
    rough = cofactors / det3(m)[..., None, None]
    # Newton's step: a body at rest has forces as large as what rounding leaves here
    return rough + rough @ (torch.eye(3, dtype=m.dtype) - m @ rough)
