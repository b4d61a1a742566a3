"""Inner voids of a volume mesh."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import IntArray
from diffsim.core.checked import checked
from diffsim.core.torch_names import on_constants
from diffsim.mesh.components import connected_parts
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.surface import surface_triangles


@checked
@on_constants()
def cavities(mesh: HexMesh | TetMesh) -> list[Tensor]:
    """Surfaces of the mesh's inner voids, the largest void first.

    A void is bounded by a part of the boundary that hangs together through edges and whose normals,
    which point out of the solid, point into what it encloses. Voids that touch one another, or the
    outside, along an edge are not told apart.

    Returns:
        One (num_faces, 3) int64 of node indices per void, oriented as `surface_triangles` are:
        normals point out of the solid into the void.
    """
    faces = surface_triangles(mesh).faces.numpy()
    a, b, c = mesh.x_rest.numpy()[faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0
    part = connected_parts(len(faces), *_neighbors(faces))
    enclosed = np.bincount(part, weights=volume)  # negative for a void
    order = [k for k in np.argsort(enclosed, kind="stable") if enclosed[k] < 0.0]
    return [torch.from_numpy(np.ascontiguousarray(faces[part == k])) for k in order]


def _neighbors(faces: IntArray) -> tuple[IntArray, IntArray]:
    """Pairs of faces that share an edge, (num_pairs,) each."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge = np.unique(edges, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(edge, kind="stable")
    owner, same = order // 3, edge[order][1:] == edge[order][:-1]
    return owner[:-1][same], owner[1:][same]
