"""Shape-function gradients and quadrature weights at rest: what the element kernels read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.core.checked import checked
from diffsim.core.torch_names import on_constants
from diffsim.mesh.congruence import congruence_classes
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import (
    HEX_GAUSS,
    Array,
    det3,
    hex_jacobians,
    hex_shape,
    hex_shape_derivatives,
    inv3,
)

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
    x = mesh.x_rest.numpy()
    if isinstance(mesh, HexMesh):
        hexes = mesh.hexes.numpy()
        representative, class_idx = congruence_classes(x, hexes)
        grad, weight = hex_gradients(x[hexes[representative]])
        return _freeze(grad, weight, class_idx)
    grad, weight = tet_gradients(x[mesh.tets.numpy()])
    return _freeze(grad[:, None], weight[:, None], np.arange(mesh.num_elements, dtype=np.int64))


@checked
@on_constants()
def nodal_shares(mesh: HexMesh | TetMesh) -> Tensor:
    """Volume of each element lumped to its nodes: the integrals of its shape functions.

    Hex: 2x2x2 Gauss, exact for trilinear geometry. Tet: V/4 to each node.

    Returns:
        (num_elements, 8 or 4) [m^3], positive, in the order of ``mesh.elements``.
    """
    shape = shape_gradients(mesh)
    if mesh.kind == "hex":
        share = shape.weight @ torch.from_numpy(hex_shape(HEX_GAUSS))
    else:
        share = shape.weight.expand(-1, 4) / 4.0
    return share[shape.class_idx]


@checked
@on_constants()
def nodal_volume(mesh: HexMesh | TetMesh) -> Tensor:
    """Volume lumped to the nodes, see :func:`nodal_shares`.

    Returns:
        (num_nodes,) [m^3], positive, summing to the mesh's volume; times density it is the
        lumped mass.
    """
    out = torch.zeros(mesh.num_nodes, dtype=torch.float64)
    return out.index_add_(0, mesh.elements.flatten(), nodal_shares(mesh).flatten())


def hex_gradients(corners: Array) -> tuple[Array, Array]:
    """Gradients (C, 8, 8, 3) [1/m] and weights (C, 8) [m^3] of hexahedra (C, 8, 3) [m]."""
    derivatives = hex_shape_derivatives(HEX_GAUSS)
    grad = np.empty((len(corners), 8, 8, 3))
    weight = np.empty((len(corners), 8))
    for start in range(0, len(corners), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        jacobians = hex_jacobians(corners[chunk], HEX_GAUSS)
        grad[chunk] = derivatives[None] @ inv3(jacobians)  # (dN/ds)_ac (J^-1)_ci
        weight[chunk] = det3(jacobians) / 8.0
    return grad, weight


def tet_gradients(corners: Array) -> tuple[Array, Array]:
    """Gradients (E, 4, 3) [1/m] and volumes (E,) [m^3] of tetrahedra (E, 4, 3) [m]."""
    edges = corners[:, 1:] - corners[:, :1]  # rows x_a - x_0 = J'
    grad = np.empty(corners.shape)
    grad[:, 1:] = inv3(edges).transpose(0, 2, 1)  # rows of J^-1
    grad[:, 0] = -grad[:, 1:].sum(axis=1)
    return grad, det3(edges) / 6.0


def _freeze(grad: Array, weight: Array, class_idx: np.ndarray) -> ShapeGradients:
    arrays = (np.ascontiguousarray(a) for a in (grad, weight, class_idx))
    return ShapeGradients(*(torch.from_numpy(a) for a in arrays))
