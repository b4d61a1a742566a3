"""Tetrahedra split in eight: finer meshes of a shape, and what ten-node elements are made of."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import IntArray
from diffsim.core.check import require
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.torch_names import on_constants
from diffsim.mesh.core import TetMesh
from diffsim.mesh.reference import TET_EDGES

EIGHTHS: IntArray = np.array(
    [
        [0, 4, 5, 6],
        [4, 1, 7, 8],
        [5, 7, 2, 9],
        [6, 8, 9, 3],
        [5, 8, 4, 7],
        [5, 8, 7, 9],
        [5, 8, 9, 6],
        [5, 8, 6, 4],
    ],
    np.int64,
)
"""The eighths of a ten-node tetrahedron: four corners, then around the diagonal 5-8, (8, 4). Nodes
4 to 9 are the midpoints of ``TET_EDGES``."""


@checked
@on_constants()
def split_tets(mesh: TetMesh) -> TetMesh:
    """A mesh whose tetrahedra are each split in eight, at the midpoints of their edges.

    Elements 8 e to 8 e + 7 are the eighths of element e; old vertices keep their indices.

    Args:
        mesh: The coarse mesh.

    Returns:
        The fine mesh, of the same shape. ``SoftBody(..., element="quadratic")`` takes it.
    """
    middle = mesh.num_nodes + _edges(mesh)[1].reshape(-1, 6)
    ten = np.concatenate([mesh.tets.numpy(), middle], axis=1)
    nodes = split_positions(mesh, mesh.x_rest)
    return TetMesh(nodes, torch.from_numpy(ten[:, EIGHTHS].reshape(-1, 4)))


@checked
def split_positions(mesh: TetMesh, x: Tensor) -> Tensor:
    """Positions of the nodes of ``split_tets(mesh)`` whose coarse mesh lies at x.

    Args:
        mesh: The coarse mesh.
        x: Positions of its nodes, (num_nodes, 3) [m].

    Returns:
        (num_nodes + num_edges, 3) [m]: x, then the midpoints of the edges. Gradient: x.
    """
    x = require("x", x, (mesh.num_nodes, 3))
    with on_constants():
        ends = torch.from_numpy(_edges(mesh)[0])
    return torch.cat([x, x[ends].mean(1)])


def _edges(mesh: TetMesh) -> tuple[IntArray, IntArray]:
    """Ends of all edges (num_edges, 2), and the edges of the tetrahedra (num_elements * 6,)."""
    edges = np.sort(mesh.tets.numpy()[:, TET_EDGES].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    return unique, inverse.reshape(-1)


@on_constants()
def join_eighths(mesh: TetMesh) -> IntArray:
    """Ten nodes of each tetrahedron that was split in eight, (num_elements / 8, 10).

    Raises:
        MeshError: the mesh is not as ``split_tets`` makes it.
    """
    hint = "is not made of tetrahedra split in eight; make it by mesh.split_tets(coarse)"
    if mesh.num_elements % 8:
        raise MeshError(f"the mesh of {mesh.num_elements} tetrahedra {hint}")
    eighths = mesh.tets.numpy().reshape(-1, 8, 4)
    ten = np.empty((len(eighths), 10), np.int64)
    for k in reversed(range(8)):
        ten[:, EIGHTHS[k]] = eighths[:, k]
    x = mesh.x_rest.numpy()
    ends = x[ten[:, TET_EDGES]]
    length = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
    away = np.linalg.norm(ends.mean(axis=2) - x[ten[:, 4:]], axis=2)
    odd = (ten[:, EIGHTHS] != eighths).any((1, 2)) | (away > 1e-6 * length).any(1)
    if odd.any():
        raise MeshError(f"the mesh (elements from {8 * int(odd.argmax())} on) {hint}")
    return ten
