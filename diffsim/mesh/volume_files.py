"""Content of a volume mesh file as it stands: points, elements, and what is said per element.

GMSH, VTK, Abaqus and Medit are read by meshio, USD by ``diffsim.mesh.usd_files``. Nothing is
checked here but that there is one kind of elements; ``diffsim.mesh.load`` makes a mesh of it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.core.xml_text import refuse_document_type
from diffsim.mesh.reference import HEX_FROM_VTK
from diffsim.mesh.vtu_size import require_unpacked

MESHIO_FORMATS = {
    ".vtu": "vtu",
    ".vtk": "vtk",
    ".msh": "gmsh",
    ".inp": "abaqus",
    ".mesh": "medit",
}
"""Extension to meshio format; all of them number a hexahedron's nodes as VTK does.

Not .xdmf: meshio needs h5py for it, even to read XML."""

USD_FORMATS = (".usd", ".usda", ".usdc")

_INCLUDE = re.compile(rb"^\s*\*\s*INCLUDE", re.I | re.M)
_BOUNDARY_CELLS = {"vertex", "line", "triangle", "quad"}


@dataclass(frozen=True, eq=False)
class VolumeFile:
    """What a file holds.

    Attributes:
        x: Positions of the nodes, (num_nodes, 3) [unit of the file].
        elements: Node indices, (num_elements, 8) or (num_elements, 4), in this library's order.
        element_data: Named values of the elements, (num_elements, ...) each.
        groups: Indices of the elements of each named group; elements may be in several.
        tag_names: Names of GMSH's physical groups of volumes, by their tag.
    """

    x: Array
    elements: IntArray
    element_data: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    groups: Mapping[str, IntArray] = field(default_factory=dict)
    tag_names: Mapping[int, str] = field(default_factory=dict)


def read_meshio(path: Path, file_format: str) -> VolumeFile:
    """Read a file through meshio.

    Args:
        file_format: meshio's name of its format.

    Raises:
        MeshError: it cannot be read, or includes another file; no volume elements; several kinds,
            or such of higher order.
    """
    import meshio

    if file_format == "abaqus" and _INCLUDE.search(path.read_bytes()):  # meshio reads any file
        raise MeshError(f"{path} includes another file, which is not done here; write one file")
    try:
        if file_format == "vtu":
            refuse_document_type(path)
            require_unpacked(path)
        # meshio.read itself prints what is wrong, and ends the program
        content = getattr(meshio, file_format).read(path)
    except (Exception, SystemExit) as error:
        said = str(error) or "it is cut off, or of another kind"
        raise MeshError(f"{path} could not be read as {file_format}: {said}") from error
    kind, chosen = _one_kind(path, content.cells)
    elements = _join_blocks([content.cells[b].data for b in chosen]).astype(np.int64)
    if kind == "hexahedron":
        elements = elements[:, HEX_FROM_VTK]
    x = np.asarray(content.points, np.float64)
    if x.ndim != 2 or x.shape[1] != 3:
        raise MeshError(f"{path} must hold points in three dimensions, got shape {x.shape}")
    data = {
        key: _join_blocks([np.asarray(blocks[b]) for b in chosen])
        for key, blocks in content.cell_data.items()
    }
    sizes = [len(content.cells[b].data) for b in chosen]
    groups = {
        name: _members([members[b] for b in chosen], sizes)
        for name, members in content.cell_sets.items()
        if not name.startswith("gmsh:")  # tags of neighboring surfaces, no elements
    }
    groups = {name: members for name, members in groups.items() if len(members)}
    tags = {int(tag): name for name, (tag, dim) in content.field_data.items() if int(dim) == 3}
    return VolumeFile(x, elements, data, groups, tags)


def _one_kind(path: Path, cells: Sequence[Any]) -> tuple[str, list[int]]:
    """The kind of the volume elements, and the blocks that hold them."""
    counts: dict[str, int] = {}
    for block in cells:
        if block.type not in _BOUNDARY_CELLS and len(block.data):
            counts[block.type] = counts.get(block.type, 0) + len(block.data)
    if not counts:
        found = sorted({block.type for block in cells}) or ["nothing"]
        raise MeshError(f"{path} holds no volume elements, only {', '.join(found)}")
    if len(counts) > 1 or not counts.keys() <= {"tetra", "hexahedron"}:
        raise MeshError(
            f"{path} must hold either tetra or hexahedron elements of first order, got "
            f"{' and '.join(f'{count} {kind}' for kind, count in counts.items())}; export one "
            "kind, or split the others into tetrahedra"
        )
    kind = next(iter(counts))
    return kind, [b for b, block in enumerate(cells) if block.type == kind and len(block.data)]


def _members(blocks: Sequence[Any], sizes: Sequence[int]) -> IntArray:
    """Members of a group as indices of the joined elements."""
    starts = np.cumsum([0, *sizes])[:-1]
    parts = [
        start + np.asarray(block, np.int64)
        for start, block in zip(starts, blocks, strict=True)
        if block is not None
    ]
    return _join_blocks(parts) if parts else np.zeros(0, np.int64)


def _join_blocks(blocks: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
