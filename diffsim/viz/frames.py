"""A moving surface: its faces, and its places over time, as one small file."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Outward faces of a hexahedron in lexicographic node order (see ``diffsim.mesh.HexMesh``).
HEX_FACES = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
)


def surface_quads(hexes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces that belong to one element only.

    Args:
        hexes: Node indices of the hexahedra, (E, 8).

    Returns:
        quads (Q, 4) into the list of surface nodes, counter-clockwise from outside, and that list
        (N,) of node indices, ascending.
    """
    faces = hexes[:, HEX_FACES].reshape(-1, 4)
    _, first, count = np.unique(
        np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
    )
    outer = faces[np.sort(first[count == 1])]
    nodes, local = np.unique(outer, return_inverse=True)
    return local.reshape(-1, 4), nodes


def triangles(quads: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles for each quadrilateral, (2 Q, 3) from (Q, 4)."""
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def pack(**arrays: NDArray[Any]) -> bytes:
    """Arrays as the bytes of an ``.npz``."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()
