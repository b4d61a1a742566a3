"""The boundary of a volume mesh, oriented outwards, and which element each face came from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.core.arrays import IntArray
from diffsim.core.checked import checked
from diffsim.core.numbers import to_numpy
from diffsim.core.torch_names import on_constants
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_FACES, TET_FACES

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Surface:
    """Boundary faces of a volume mesh; indices are those of the volume mesh's nodes.

    Attributes:
        faces: Node indices counter-clockwise seen from outside, (num_faces, 3) or (num_faces, 4)
            int64, ordered by parent element, then by local face.
        element_idx: The element a face belongs to, (num_faces,) int64.
    """

    faces: Tensor
    element_idx: Tensor


@checked
@on_constants()
def surface_triangles(mesh: HexMesh | TetMesh) -> Surface:
    """Boundary triangles; a hexahedron's quad (a, b, c, d) gives (a, b, c) and (a, c, d)."""
    if isinstance(mesh, TetMesh):
        return _boundary(mesh.tets.numpy(), TET_FACES)
    quads = surface_quads(mesh)
    triangles = quads.faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return Surface(triangles, quads.element_idx.repeat_interleave(2))


@checked
@on_constants()
def surface_quads(mesh: HexMesh) -> Surface:
    """Boundary quads of a hexahedral mesh."""
    return _boundary(mesh.hexes.numpy(), HEX_FACES)


@checked
@on_constants()
def surface_vertices(mesh: HexMesh | TetMesh) -> Tensor:
    """Nodes on the boundary, ascending, (num_surface_vertices,) int64."""
    faces = surface_quads(mesh) if isinstance(mesh, HexMesh) else surface_triangles(mesh)
    return torch.unique(faces.faces)


@checked(x=("num_nodes", 3))
def to_trimesh(mesh: HexMesh | TetMesh, x: Tensor | None = None) -> trimesh.Trimesh:
    """The boundary as a `trimesh.Trimesh` with its own numbering.

    Args:
        mesh: The volume mesh.
        x: Positions to show instead of ``x_rest``, (num_nodes, 3) [m].

    Returns:
        Vertices in the order of `surface_vertices`; ``metadata["vertex_idx"]`` holds these indices
        and ``metadata["element_idx"]`` the parent of each face. Watertight unless elements meet
        only along an edge or at a node.
    """
    import trimesh

    surface = surface_triangles(mesh)
    positions = to_numpy("x", mesh.x_rest if x is None else x)
    vertex_idx, local = np.unique(to_numpy("faces", surface.faces), return_inverse=True)
    return trimesh.Trimesh(
        vertices=positions[vertex_idx],
        faces=local.reshape(surface.faces.shape),
        process=False,
        metadata={
            "vertex_idx": vertex_idx,
            "element_idx": to_numpy("element_idx", surface.element_idx),
        },
    )


def boundary_faces(elements: IntArray, local_faces: IntArray) -> tuple[IntArray, IntArray]:
    """Faces that occur once among all faces of all elements, and the element of each."""
    faces = elements[:, local_faces].reshape(-1, local_faces.shape[1])
    _, first, count = np.unique(face_keys(faces), return_index=True, return_counts=True)
    alone = np.sort(first[count == 1])
    return np.ascontiguousarray(faces[alone]), (alone // len(local_faces)).astype(np.int64)


def face_keys(faces: IntArray) -> IntArray:
    """One integer per face, equal exactly for faces with the same nodes, (num_faces,)."""
    return _row_keys(np.sort(faces, axis=1))


def _boundary(elements: IntArray, local_faces: IntArray) -> Surface:
    faces, element_idx = boundary_faces(elements, local_faces)
    return Surface(torch.from_numpy(faces), torch.from_numpy(element_idx))


def _row_keys(rows: IntArray) -> IntArray:
    """Equal keys for equal rows of sorted node indices, without clashes."""
    size = int(rows.max()) + 1
    keys = rows[:, 0]
    for column in rows.T[1:]:
        # renumber what has been combined so far, so that the product stays below 2^63
        if int(keys.max()) > (2**62) // size:
            keys = np.unique(keys, return_inverse=True)[1].reshape(-1)
        keys = keys * size + column
    return keys
