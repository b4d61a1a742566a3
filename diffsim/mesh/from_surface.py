"""Fill a closed triangle surface with hexahedra or tetrahedra."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from diffsim.core.check import require_choice, require_number
from diffsim.core.optional import optional
from diffsim.core.record import warn
from diffsim.mesh.closed_surface import SurfaceLike, closed_surface
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.distance import SurfaceDistance
from diffsim.mesh.inside import grid_inside
from diffsim.mesh.reference import Array, IntArray
from diffsim.mesh.repair import flip_inverted, remove_degenerate
from diffsim.mesh.stuffing import fill
from diffsim.mesh.voxels import ask_for_unit, grid, hex_from_mask

FINEST = 1e-4  # spacing over the diagonal: some 1e12 elements, more than a memory holds


def voxelize(surface: SurfaceLike, spacing: float, keep: str = "largest") -> HexMesh:
    """Cubes whose center lies inside a closed surface.

    Args:
        surface: A watertight `trimesh.Trimesh`, or the path of a surface file in meters.
        spacing: Edge length of the cubes [m]; the grid is centered on the bounding box.
        keep: "largest": only the largest part that hangs together through faces; "all". Cubes
            that hang on by a mere edge or node are dropped either way.

    Raises:
        MeshError: the surface is not closed, or no center is inside.
    """
    spacing = require_number("spacing", spacing, above=0.0)
    x, faces = closed_surface(surface)
    _, counts = grid([x.min(axis=0).tolist(), x.max(axis=0).tolist()], spacing)
    low = 0.5 * (x.min(axis=0) + x.max(axis=0)) - 0.5 * spacing * counts
    inside = grid_inside(x, faces, low + 0.5 * spacing, spacing, counts)
    return hex_from_mask(inside, low, spacing, keep)


def tetrahedralize(
    surface: SurfaceLike,
    spacing: float,
    *,
    method: str = "auto",
    tolerance: float | None = None,
) -> TetMesh:
    """Tetrahedra that fill a closed surface.

    Args:
        surface: A watertight `trimesh.Trimesh`, or the path of a surface file in meters.
        spacing: Target edge length [m].
        method: "ftetwild" keeps sharp edges (Hu et al. 2020, "Fast Tetrahedral Meshing in the
            Wild"; needs ``pip install pytetwild``; two runs give two meshes, so save
            what you publish); "stuffing" is reproducible, needs nothing further
            and rounds features below ``spacing`` (`tet_from_sdf`); "auto" takes the first where it
            is installed and otherwise warns and takes the second.
        tolerance: How far fTetWild may depart from the surface [m]; 1e-3 of the diagonal of the
            bounding box when not given. "stuffing" has no such bound and takes none.

    Raises:
        ImportError: "ftetwild" was asked for and is not installed.
        MeshError: the surface is not closed.
        ValueError: "ftetwild" with a spacing above the diagonal of the bounding box, or below 1e-4
            of it.
    """
    require_choice("method", method, ["auto", "ftetwild", "stuffing"])
    spacing = require_number("spacing", spacing, above=0.0)
    if tolerance is not None:
        tolerance = require_number("tolerance", tolerance, above=0.0)
    if method == "auto":
        try:
            _pytetwild()
            method = "ftetwild"
        except ImportError:
            warn(
                "pytetwild is not installed: tetrahedralize uses lattice stuffing, which rounds "
                "edges sharper than the spacing; pip install pytetwild keeps them, "
                "method='stuffing' silences this",
                stacklevel=2,
            )
            method = "stuffing"
    if method == "ftetwild":
        return _ftetwild(*closed_surface(surface), spacing, tolerance)
    if tolerance is not None:
        raise ValueError(
            "tolerance is for method='ftetwild'; 'stuffing' has no bound, leave it out"
        )
    distance = SurfaceDistance(surface)
    bounds = [distance.x.min(axis=0).tolist(), distance.x.max(axis=0).tolist()]

    def inside(first: Array, counts: IntArray) -> np.ndarray:
        return grid_inside(distance.x, distance.faces, first, spacing, counts)

    return fill(lambda p: distance(p.numpy()), bounds, spacing, "largest", inside)


def _pytetwild() -> ModuleType:
    return optional(
        "pytetwild",
        purpose="tetrahedralize(method='ftetwild')",
        otherwise="use method='stuffing'",
    )


def _ftetwild(x: Array, faces: IntArray, spacing: float, tolerance: float | None) -> TetMesh:
    """One thread, so that callers decide how many processors are busy."""
    diagonal = float(np.linalg.norm(x.max(axis=0) - x.min(axis=0)))
    if not FINEST * diagonal <= spacing <= diagonal:  # beyond these fTetWild does not end
        raise ValueError(
            f"spacing must be from {FINEST:g} to 1 times the diagonal of the surface's bounding "
            f"box, {diagonal:.3g} m, got {spacing:g} m{ask_for_unit(diagonal)}"
        )
    by_product = Path("__tracked_surface.stl")  # pytetwild 0.2.3 leaves it in the current folder
    existed = by_product.exists()
    points, tets = _pytetwild().tetrahedralize(
        x,
        np.ascontiguousarray(faces, np.int32),
        edge_length_abs=spacing,
        epsilon=1e-3 if tolerance is None else tolerance / diagonal,
        num_threads=1,
        quiet=True,
    )
    if not existed:
        by_product.unlink(missing_ok=True)
    nodes = torch.from_numpy(np.asarray(points, np.float64))
    elements = torch.from_numpy(np.asarray(tets, np.int64))
    return TetMesh(*flip_inverted(*remove_degenerate(nodes, elements)))
