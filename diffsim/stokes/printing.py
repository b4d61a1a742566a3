"""From a closed surface to a printer: what is wrong with a solid, and its STL file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from diffsim.core.check import require_choice
from diffsim.core.errors import MeshError
from diffsim.core.files import write_bytes_atomic

if TYPE_CHECKING:
    import trimesh

UNITS = {"m": 1.0, "mm": 1e3, "um": 1e6}
"""Units of an STL file per meter; the format itself has none, slicers take millimeters."""


@dataclass(frozen=True, kw_only=True)
class FabricationReport:
    """What can be said of a solid before it is printed."""

    is_watertight: bool  # every edge has two triangles, all facing outwards
    volume: float  # volume of the solid [m^3]
    # volumes of the separate parts, largest first [m^3]; all but the first are loose
    part_volumes: tuple[float, ...]
    # volumes of voids without a way out, largest first [m^3]: resin or powder stays in
    cavity_volumes: tuple[float, ...]
    size: tuple[float, float, float]  # size of the bounding box [m]

    @property
    def num_parts(self) -> int:
        return len(self.part_volumes)

    @property
    def loose_volume(self) -> float:
        """Volume of all parts but the largest [m^3]."""
        return sum(self.part_volumes[1:])


def fabrication_report(mesh: trimesh.Trimesh) -> FabricationReport:
    """Is a surface closed, and how many parts and cavities does it have?"""
    import trimesh

    if not isinstance(mesh, trimesh.Trimesh):
        raise TypeError(f"mesh must be a trimesh.Trimesh, got {type(mesh).__name__}")
    faces, count = mesh.faces, len(mesh.vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    _, label = sparse.csgraph.connected_components(graph, directed=False)
    corners = mesh.triangles - mesh.bounds.mean(0)
    signed = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    present, which = np.unique(label[faces[:, 0]], return_inverse=True)
    volumes = np.bincount(which, weights=signed, minlength=len(present))
    return FabricationReport(
        is_watertight=bool(mesh.is_watertight and mesh.is_winding_consistent),
        volume=float(volumes.sum()),
        part_volumes=tuple(sorted(volumes[volumes > 0.0].tolist(), reverse=True)),
        cavity_volumes=tuple(sorted((-volumes[volumes < 0.0]).tolist(), reverse=True)),
        size=tuple(mesh.extents.tolist()),
    )


def write_stl(path: str | Path, mesh: trimesh.Trimesh, *, unit: str = "mm") -> Path:
    """Write a closed surface as binary STL; the file appears whole or not at all.

    Args:
        path: File name with the extension .stl; folders are made.
        mesh: Surface [m], such as that of ``fabrication_mesh``.
        unit: Unit of the file's numbers: "mm" (what slicers take), "m" or "um".

    Raises:
        MeshError: the surface has holes.
    """
    import trimesh

    path = Path(path)
    if path.suffix.lower() != ".stl":
        raise ValueError(f"path must end in .stl, got {path.name!r}")
    scale = UNITS[require_choice("unit", unit, UNITS)]
    if not isinstance(mesh, trimesh.Trimesh):
        raise TypeError(f"mesh must be a trimesh.Trimesh, got {type(mesh).__name__}")
    if not mesh.is_watertight:
        raise MeshError("mesh must be closed to be printed; fabrication_mesh makes such surfaces")
    scaled = trimesh.Trimesh(mesh.vertices * scale, mesh.faces, process=False)
    return write_bytes_atomic(path, trimesh.exchange.stl.export_stl(scaled))
