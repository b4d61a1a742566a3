"""Boxes of hexahedra or tetrahedra, the meshes with a known order of nodes and elements."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from diffsim.core.arrays import Array, IntArray
from diffsim.core.check import require_counts, require_numbers
from diffsim.core.checked import checked
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_CORNERS

KUHN: IntArray = np.array(
    [[0, 4, 6, 7], [0, 5, 4, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 1, 5, 7], [0, 3, 1, 7]], np.int64
)
"""Six right-handed tetrahedra around the diagonal 0-7 of a cell; neighbors conform, (6, 4)."""


def hex_box(
    cells: Sequence[int] = (4, 4, 4),
    size: Sequence[float] = (1.0, 1.0, 1.0),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> HexMesh:
    """A box of nx x ny x nz equal hexahedra.

    Nodes and elements are lexicographic in (i, j, k), k fastest: node (i, j, k) has the index
    ``(i (ny + 1) + j) (nz + 1) + k`` and lies at origin + (i lx/nx, j ly/ny, k lz/nz).

    Args:
        cells: Cells per axis, (nx, ny, nz), each at least 1.
        size: Edge lengths of the box, (lx, ly, lz) [m], positive.
        origin: Lower corner [m].
    """
    x, hexes = box_arrays(cells, size, origin)
    return HexMesh(torch.from_numpy(x), torch.from_numpy(hexes))


@checked
def tet_box(
    cells: Sequence[int] = (4, 4, 4),
    size: Sequence[float] = (1.0, 1.0, 1.0),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    symmetric: bool = False,
) -> TetMesh:
    """The nodes of `hex_box`, each cell split in six (Kuhn); element 6 e + t lies in cell e.

    Args:
        cells: Cells per axis, (nx, ny, nz), each at least 1.
        size: Edge lengths of the box, (lx, ly, lz) [m], positive.
        origin: Lower corner [m].
        symmetric: Whether a cell is the mirror image of its neighbors, so that a box of even
            ``cells`` has the symmetries of its shape. Otherwise all diagonals point one way, and
            what bends a body turns it sideways, too.
    """
    x, hexes = box_arrays(cells, size, origin)
    tets = hexes[:, KUHN]
    if symmetric:
        odd = np.indices(require_counts("cells", cells, 3)).reshape(3, -1) % 2
        mirror = odd[0] * 4 + odd[1] * 2 + odd[2]  # of local nodes a to a xor mirror
        tets = np.take_along_axis(hexes, (KUHN.reshape(1, -1) ^ mirror[:, None]), axis=1)
        tets = tets.reshape(-1, 6, 4)
        turned = odd.sum(axis=0) % 2 == 1
        tets[turned] = tets[turned][:, :, [0, 1, 3, 2]]
    return TetMesh(torch.from_numpy(x), torch.from_numpy(tets.reshape(-1, 4)))


MAX_NODES = 500_000_000
"""More would not fit into memory, and are most likely a mistake of units."""


def box_arrays(
    cells: Sequence[int], size: Sequence[float], origin: Sequence[float]
) -> tuple[Array, IntArray]:
    """Nodes (V, 3) [m] and hexahedra (E, 8) of a box, unchecked but for the arguments."""
    count = require_counts("cells", cells, 3)
    if math.prod(n + 1 for n in count) > MAX_NODES:
        raise ValueError(f"cells must make at most {MAX_NODES:,} nodes, got {count}")
    lengths = require_numbers("size", size, 3, above=0.0)
    start = require_numbers("origin", origin, 3)
    axes = [start[c] + np.arange(count[c] + 1) * (lengths[c] / count[c]) for c in range(3)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    ijk = np.indices(count).reshape(3, -1).T
    return np.ascontiguousarray(x), grid_hexes(ijk, count)


def grid_hexes(ijk: IntArray, cells: Sequence[int]) -> IntArray:
    """Node indices, (E, 8), of the cells ``ijk`` (E, 3) of a full grid of ``cells``."""
    corner = ijk[:, None, :] + HEX_CORNERS[None]
    return (corner[..., 0] * (cells[1] + 1) + corner[..., 1]) * (cells[2] + 1) + corner[..., 2]
