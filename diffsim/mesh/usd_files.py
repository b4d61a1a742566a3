"""Tetrahedra of USD files (UsdGeomTetMesh), with GeomSubsets as named groups.

OpenUSD is an optional package: ``pip install usd-core``. Only the named layer is read: a stage can
pull in any file of the machine by reference, and a mesh has no need of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.arrays import IntArray
from diffsim.core.errors import MeshError
from diffsim.core.optional import optional
from diffsim.mesh.volume_files import VolumeFile

# Y up, as in tools for pictures, to z up: a quarter turn about x.
_Z_FROM_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def read_usd(path: Path) -> VolumeFile:
    """Read the one tetrahedral mesh of a stage.

    Positions are in meters and z up where the stage says its unit and its up axis; transforms of
    the prims above are applied.

    Args:
        path: A .usd, .usda or .usdc file.

    Raises:
        ImportError: OpenUSD is not installed, or too old.
        ValueError: the file pulls in others.
        MeshError: it cannot be read, has no or several tetrahedral meshes, or broken indices.
    """
    pxr: Any = optional("pxr", purpose=f"reading {path.name}")
    from pxr import Sdf, Usd, UsdGeom

    if not hasattr(UsdGeom, "TetMesh"):
        raise ImportError(f"reading {path.name} needs usd-core 24.3 or later, got {pxr.__file__}")
    try:
        layer = Sdf.Layer.FindOrOpen(str(path))
        if layer is not None:
            layer.Reload()  # else a file that was written again reads as it did
            _require_alone(path, layer)
        stage = None if layer is None else Usd.Stage.Open(layer)
    except Exception as error:
        if isinstance(error, ValueError):
            raise
        raise MeshError(f"{path} could not be read as USD: {error}") from error
    if stage is None:
        raise MeshError(f"{path} could not be read as USD")
    if clipped := [str(p.GetPath()) for p in stage.Traverse() if p.HasAuthoredMetadata("clips")]:
        raise ValueError(f"{path} takes values of {clipped[0]} from other files, by clips")
    found = [p for p in stage.Traverse() if p.IsA(UsdGeom.TetMesh)]
    if len(found) != 1:
        names = ", ".join(str(p.GetPath()) for p in found) or "none"
        raise MeshError(
            f"{path} must hold one TetMesh, it holds {len(found)} ({names}); write each body to "
            "a file of its own"
        )
    return _read(path, stage, found[0], UsdGeom)


def _require_alone(path: Path, layer: Any) -> None:
    others = {*layer.GetCompositionAssetDependencies(), *layer.GetExternalAssetDependencies()}
    others.discard("")
    if others:
        raise ValueError(
            f"{path} pulls in other files ({', '.join(sorted(others)[:3])}), which are not read: "
            "make it one file with usdcat --flatten"
        )


def _read(path: Path, stage: Any, prim: Any, geom: Any) -> VolumeFile:
    tets = geom.TetMesh(prim)
    points = tets.GetPointsAttr().Get()
    indices = tets.GetTetVertexIndicesAttr().Get()
    if points is None or indices is None or not len(points) or not len(indices):
        raise MeshError(f"{path}: {prim.GetPath()} has no points or no tetVertexIndices")
    elements = np.asarray(indices, np.int64).reshape(-1, 4)
    if tets.GetOrientationAttr().Get() == geom.Tokens.leftHanded:
        elements = elements[:, [0, 2, 1, 3]]
    matrix = np.asarray(geom.XformCache().GetLocalToWorldTransform(prim))  # acts on rows
    x = np.asarray(points, np.float64) @ matrix[:3, :3] + matrix[3, :3]
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        elements = elements[:, [0, 2, 1, 3]]
    if stage.HasAuthoredMetadata(geom.Tokens.metersPerUnit):
        x = x * geom.GetStageMetersPerUnit(stage)
    up = stage.HasAuthoredMetadata(geom.Tokens.upAxis)
    if up and geom.GetStageUpAxis(stage) == geom.Tokens.y:
        x = x @ _Z_FROM_Y.T
    groups = {
        subset.GetPrim().GetName(): _subset(path, subset, len(elements))
        for subset in geom.Subset.GetAllGeomSubsets(geom.Imageable(prim))
        if subset.GetElementTypeAttr().Get() == "tetrahedron"
    }
    return VolumeFile(
        x, elements, {}, {n: members for n, members in groups.items() if len(members)}
    )


def _subset(path: Path, subset: Any, size: int) -> IntArray:
    given = subset.GetIndicesAttr().Get()
    members = np.asarray([] if given is None else given, np.int64)
    outside = members[(members < 0) | (members >= size)]
    if len(outside):
        raise MeshError(
            f"{path}: {subset.GetPath()} names tetrahedron {int(outside[0])}, there are {size}"
        )
    return members
