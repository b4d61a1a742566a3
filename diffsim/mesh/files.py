"""Meshes from files and to files: volumes through meshio, surfaces through trimesh.

Files carry no unit: coordinates are taken as meters unless ``scale`` says otherwise.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import require, require_number
from diffsim.core.errors import MeshError
from diffsim.core.files import replacing
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_FROM_VTK, VTK_FROM_HEX
from diffsim.mesh.repair import remove_unreferenced_nodes
from diffsim.mesh.surface import to_trimesh
from diffsim.mesh.surface_check import check_file, check_indices

if TYPE_CHECKING:
    import trimesh


VOLUME_FORMATS = {
    ".vtu": "vtu",
    ".vtk": "vtk",
    ".msh": "gmsh",
    ".inp": "abaqus",
    ".mesh": "medit",
}
"""Extension to meshio format; all of them number a hexahedron's nodes as VTK does.

Not .xdmf: meshio needs h5py for it, even to read XML."""

SURFACE_FORMATS = (".stl", ".obj", ".ply", ".off", ".glb")

_BOUNDARY_CELLS = {"vertex", "line", "triangle", "quad"}


def load(path: str | Path, scale: float = 1.0) -> HexMesh | TetMesh:
    """Read a volume mesh; nodes that no element uses are dropped.

    Args:
        path: A file with one of the extensions .vtu, .vtk, .msh, .inp, .mesh.
        scale: Meters per unit of the file, 1e-3 for millimeters.

    Raises:
        FileNotFoundError: no such file.
        ValueError: unknown extension, or a surface file.
        MeshError: mixed or unsupported elements, or a mesh that cannot be simulated.
    """
    x, elements = load_arrays(path, scale)
    x, elements = remove_unreferenced_nodes(x, elements)
    try:
        return HexMesh(x, elements) if elements.shape[1] == 8 else TetMesh(x, elements)
    except MeshError as error:
        raise MeshError(
            f"{path}: {error} (x_rest and the elements come from diffsim.mesh.load_arrays(path), "
            "without the nodes that no element uses)",
            error.indices,
        ) from error


def load_arrays(path: str | Path, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """Positions (V, 3) float64 [m] and elements (E, 8) or (E, 4) int64 of a file, unchecked."""
    path = Path(path)
    scale = require_number("scale", scale, above=0.0)
    suffix = _suffix(path, list(VOLUME_FORMATS))
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}{_similar_files(path)}")
    import meshio

    try:
        content = meshio.read(path, file_format=VOLUME_FORMATS[suffix])
    except (Exception, SystemExit) as error:  # meshio ends the program on some bad files
        raise MeshError(f"{path} could not be read as {VOLUME_FORMATS[suffix]}: {error}") from error
    cells: dict[str, list[np.ndarray]] = {}
    for block in content.cells:
        if block.type not in _BOUNDARY_CELLS and len(block.data):
            cells.setdefault(block.type, []).append(block.data)
    if not cells:
        found = sorted({block.type for block in content.cells}) or ["nothing"]
        raise MeshError(f"{path} holds no volume elements, only {', '.join(found)}")
    if len(cells) > 1 or not cells.keys() <= {"tetra", "hexahedron"}:
        found = [f"{sum(map(len, v))} {k}" for k, v in cells.items()]
        raise MeshError(
            f"{path} must hold either tetra or hexahedron elements of first order, got "
            f"{' and '.join(found)}; export one kind, or split the others into tetrahedra"
        )
    kind, blocks = next(iter(cells.items()))
    elements = np.concatenate(blocks).astype(np.int64)
    if kind == "hexahedron":
        elements = elements[:, HEX_FROM_VTK]
    x = np.asarray(content.points, np.float64) * scale
    if x.ndim != 2 or x.shape[1] != 3:
        raise MeshError(f"{path} must hold points in three dimensions, got shape {x.shape}")
    return torch.from_numpy(np.ascontiguousarray(x)), torch.from_numpy(elements)


def load_surface(path: str | Path, scale: float = 1.0) -> trimesh.Trimesh:
    """Read a triangle surface (.stl, .obj, .ply, .off, .glb); several bodies become one mesh.

    Args:
        path: The file.
        scale: Meters per unit of the file, 1e-3 for millimeters.

    Raises:
        FileNotFoundError: no such file.
        ValueError: unknown extension.
        MeshError: damaged, cut off, no triangles, or faces of vertices that there are not.
    """
    path = Path(path)
    scale = require_number("scale", scale, above=0.0)
    _suffix(path, list(SURFACE_FORMATS))
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}{_similar_files(path)}")
    import trimesh

    check_file(path)
    try:
        surface = trimesh.load_mesh(path)
    except IndexError as error:
        raise MeshError(
            f"{path} could not be read: a face has a vertex that there is not ({error}), or the "
            "file is cut off; copy or export it again"
        ) from error
    except Exception as error:
        raise MeshError(
            f"{path} could not be read, it is damaged or cut off: {error}; copy or export it again"
        ) from error
    if isinstance(surface, trimesh.Scene):
        surface = surface.to_mesh()
    if not isinstance(surface, trimesh.Trimesh) or len(surface.faces) == 0:
        raise MeshError(f"{path} holds no triangles")
    try:
        check_indices(np.asarray(surface.faces, np.int64), np.asarray(surface.vertices))
    except MeshError as error:
        raise MeshError(f"{path}: {error}", error.indices) from None
    surface.apply_scale(scale)
    return surface


def save(
    mesh: HexMesh | TetMesh,
    path: str | Path,
    *,
    x: Tensor | None = None,
    node_data: Mapping[str, Tensor] | None = None,
    element_data: Mapping[str, Tensor] | None = None,
) -> Path:
    """Write a mesh, or with a surface's extension its boundary; the file appears whole or not.

    Args:
        mesh: The mesh.
        path: File to write; the extension chooses the format. Folders are made.
        x: Positions to write instead of ``x_rest``, (num_vertices, 3) [m].
        node_data: Named values, (num_vertices, ...) each; volume formats only.
        element_data: Named values, (num_elements, ...) each; volume formats only.

    Returns:
        The path.
    """
    path = Path(path)
    suffix = _suffix(path, [*VOLUME_FORMATS, *SURFACE_FORMATS])
    if x is not None:
        x = require("x", x.detach(), (mesh.num_vertices, 3))
    data = {
        "node_data": _data("node_data", node_data, mesh.num_vertices),
        "element_data": _data("element_data", element_data, mesh.num_elements),
    }
    with replacing(path, suffix) as partial:
        if suffix in SURFACE_FORMATS:
            if data["node_data"] or data["element_data"]:
                raise ValueError(f"{suffix} files hold no data; choose one of {[*VOLUME_FORMATS]}")
            to_trimesh(mesh, x).export(partial)
        else:
            _write_volume(mesh, partial, suffix, mesh.x_rest if x is None else x, data)
    return path


def _write_volume(
    mesh: HexMesh | TetMesh,
    path: Path,
    suffix: str,
    x: Tensor,
    data: dict[str, dict[str, np.ndarray]],
) -> None:
    elements = mesh.elements.numpy()
    name = "tetra"
    if mesh.kind == "hex":
        elements, name = elements[:, VTK_FROM_HEX], "hexahedron"
    import meshio

    content = meshio.Mesh(
        x.numpy(),
        [(name, elements)],
        point_data=data["node_data"],
        cell_data={key: [value] for key, value in data["element_data"].items()},
    )
    content.write(path, file_format=VOLUME_FORMATS[suffix])


def _data(name: str, values: Mapping[str, Tensor] | None, length: int) -> dict[str, np.ndarray]:
    out = {}
    for key, value in (values or {}).items():
        array = torch.as_tensor(value).detach().numpy()
        if array.ndim == 0 or len(array) != length:
            raise ValueError(
                f"{name}[{key!r}] must have {length} rows, got shape {tuple(array.shape)}"
            )
        out[key] = array
    return out


def _suffix(path: Path, known: list[str]) -> str:
    suffix = path.suffix.lower()
    if suffix in known:
        return suffix
    if suffix in SURFACE_FORMATS:
        raise ValueError(
            f"{path.name} is a surface: read it with diffsim.mesh.load_surface and fill it with "
            "voxelize or tetrahedralize"
        )
    if suffix in VOLUME_FORMATS:
        raise ValueError(f"{path.name} is a volume mesh: read it with diffsim.mesh.load")
    close = difflib.get_close_matches(suffix, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    raise ValueError(
        f"the extension of a mesh file must be one of {', '.join(known)}, got {suffix!r} "
        f"({path.name}); {hint}meshio can convert others: meshio convert {path.name} "
        f"{path.stem}{known[0]}"
    )


def _similar_files(path: Path) -> str:
    if not path.parent.is_dir():
        return f"; the folder {path.parent} does not exist"
    close = difflib.get_close_matches(path.name, [p.name for p in path.parent.iterdir()], n=3)
    return f"; did you mean {' or '.join(close)}?" if close else ""
