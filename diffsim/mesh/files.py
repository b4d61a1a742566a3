"""Meshes from files and to files: volumes through meshio, surfaces through trimesh.

Files carry no unit: coordinates are taken as meters unless ``scale`` says otherwise.
"""

from __future__ import annotations

import difflib
import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import require, require_number
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.files import replacing
from diffsim.core.numbers import to_numpy
from diffsim.core.values import as_array
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import VTK_FROM_HEX
from diffsim.mesh.repair import remove_unreferenced_nodes
from diffsim.mesh.surface import to_trimesh
from diffsim.mesh.surface_check import check_file, check_finite, check_indices
from diffsim.mesh.volume_files import MESHIO_FORMATS, USD_FORMATS, VolumeFile, read_meshio

if TYPE_CHECKING:
    import trimesh


VOLUME_FORMATS = MESHIO_FORMATS
"""Extensions of volume meshes that are written, with their format's name in meshio."""

SURFACE_FORMATS = (".stl", ".obj", ".ply", ".off", ".glb")


@checked
def load(path: str | Path, scale: float = 1.0) -> HexMesh | TetMesh:
    """Read a volume mesh; nodes that no element uses are dropped.

    Args:
        path: A file with one of the extensions .vtu, .vtk, .msh, .inp, .mesh, or of USD: .usd,
            .usda, .usdc.
        scale: Meters per unit of the file, 1e-3 for millimeters; USD says its own unit.

    Raises:
        FileNotFoundError: no such file.
        ValueError: unknown extension, or a surface file.
        MeshError: mixed or unsupported elements, or a mesh that cannot be simulated.
    """
    return mesh_of(Path(path), *load_arrays(path, scale))


def mesh_of(path: Path, x: Tensor, elements: Tensor) -> HexMesh | TetMesh:
    """The mesh of a file's arrays, without the nodes that no element uses.

    Raises:
        MeshError: a mesh that cannot be simulated; the message names the file.
    """
    x, elements = remove_unreferenced_nodes(x, elements)
    try:
        return HexMesh(x, elements) if elements.shape[1] == 8 else TetMesh(x, elements)
    except MeshError as error:
        raise MeshError(
            f"{path}: {error} (x_rest and the elements come from diffsim.mesh.load_arrays(path), "
            "without the nodes that no element uses)",
            error.indices,
        ) from error


@checked
def load_arrays(path: str | Path, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """Positions (V, 3) float64 [m] and elements (E, 8) or (E, 4) int64 of a file, unchecked."""
    content = read_volume(Path(path), scale)
    return torch.from_numpy(content.x), torch.from_numpy(content.elements)


def read_volume(path: Path, scale: float) -> VolumeFile:
    """What a file of a volume mesh holds, positions times ``scale``.

    Raises:
        FileNotFoundError: no such file.
        ValueError: unknown extension, or a surface file.
        MeshError: it cannot be read, or has no elements of one kind.
    """
    scale = require_number("scale", scale, above=0.0)
    suffix = _suffix(path, [*VOLUME_FORMATS, *USD_FORMATS])
    if not path.is_file():
        raise FileNotFoundError(f"no file {path}{_similar_files(path)}")
    if suffix in USD_FORMATS:
        from diffsim.mesh.usd_files import read_usd

        content = read_usd(path)
    else:
        content = read_meshio(path, VOLUME_FORMATS[suffix])
    return replace(content, x=np.ascontiguousarray(content.x * scale))


@checked
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
    content, kind = path.read_bytes(), path.suffix[1:].lower()
    try:
        # of bytes, so that no other file is looked for: buffers, materials, pictures
        surface = trimesh.load_mesh(io.BytesIO(content), file_type=kind, process=False)
        if isinstance(surface, trimesh.Trimesh):  # NaN is dropped below, -1 counts from the end
            check_indices(np.asarray(surface.faces, np.int64), np.asarray(surface.vertices))
            check_finite(np.asarray(surface.vertices))
            surface.process()
        else:
            surface = trimesh.load_mesh(io.BytesIO(content), file_type=kind)
    except MeshError as error:
        raise MeshError(f"{path}: {error}", error.indices) from None
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
        x: Positions to write instead of ``x_rest``, (num_nodes, 3) [m].
        node_data: Named values, (num_nodes, ...) each; volume formats only.
        element_data: Named values, (num_elements, ...) each; volume formats only.

    Returns:
        The path.
    """
    path = Path(path)
    suffix = _suffix(path, [*VOLUME_FORMATS, *SURFACE_FORMATS])
    if not isinstance(mesh, (HexMesh, TetMesh)):
        raise TypeError(f"mesh must be a HexMesh or TetMesh, got {type(mesh).__name__}")
    if x is not None:
        x = require("x", as_array("x", x).detach(), (mesh.num_nodes, 3))
    data = {
        "node_data": _data("node_data", node_data, mesh.num_nodes),
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
    elements = to_numpy("elements", mesh.elements)
    name = "tetra"
    if mesh.kind == "hex":
        elements, name = elements[:, VTK_FROM_HEX], "hexahedron"
    import meshio

    content = meshio.Mesh(
        to_numpy("x", x),
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
    if suffix in USD_FORMATS and ".vtu" in known:
        raise ValueError(f"{path.name}: USD is read, not written; choose one of {known}")
    if suffix in VOLUME_FORMATS or suffix in USD_FORMATS:
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
