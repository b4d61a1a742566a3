"""Fill a closed triangle surface with hexahedra or tetrahedra.

Which points of a regular grid the surface encloses is told by counting crossings along z.
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import TypeVar

import numpy as np
import torch

from diffsim.core.arrays import Array, IntArray
from diffsim.core.check import require_choice, require_number
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError
from diffsim.core.optional import optional
from diffsim.core.record import warn
from diffsim.mesh.closed_surface import SurfaceLike, closed_surface
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.distance import SurfaceDistance
from diffsim.mesh.measure import total_volume
from diffsim.mesh.repair import flip_inverted, remove_degenerate
from diffsim.mesh.stuffing import fill
from diffsim.mesh.surface_bodies import count_bodies, enclosed_volume
from diffsim.mesh.voxels import ask_for_unit, grid, hex_from_mask

Filled = TypeVar("Filled", HexMesh, TetMesh)
VOLUME_ERROR = 0.01  # of a mesh, above which it is said: mass and stiffness follow
FINEST = 1e-4  # spacing over the diagonal: some 1e12 elements, more than a memory holds


@checked
def voxelize(surface: SurfaceLike, spacing: float, keep: str | None = None) -> HexMesh:
    """Cubes whose center lies inside a closed surface.

    Args:
        surface: A watertight `trimesh.Trimesh`, or the path of a surface file in meters.
        spacing: Edge length of the cubes [m]; the grid is centered on the bounding box.
        keep: "largest": only the largest part that hangs together through faces; "all". Cubes
            that hang on by a mere edge or node are dropped either way. Not given: as "largest"
            of one body; several are refused.

    Raises:
        MeshError: the surface is not closed, crosses itself, encloses several bodies without
            ``keep``, or no center is inside.
    """
    spacing = require_number("spacing", spacing, above=0.0)
    x, faces = closed_surface(surface)
    keep = _choose_bodies(x, faces, keep)
    _, counts = grid([x.min(axis=0).tolist(), x.max(axis=0).tolist()], spacing)
    low = 0.5 * (x.min(axis=0) + x.max(axis=0)) - 0.5 * spacing * counts
    inside = grid_inside(x, faces, low + 0.5 * spacing, spacing, counts)
    return _warn_of_volume(hex_from_mask(inside, low, spacing, keep), x, faces)


@checked
def tetrahedralize(
    surface: SurfaceLike,
    spacing: float,
    *,
    method: str = "auto",
    tolerance: float | None = None,
    keep: str | None = None,
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
        keep: "largest" or "all" of several bodies, as in ``voxelize``; fTetWild keeps all.

    Raises:
        ImportError: "ftetwild" was asked for and is not installed.
        MeshError: the surface is not closed, crosses itself, or encloses several bodies without
            ``keep``.
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
        x, faces = closed_surface(surface)
        _choose_bodies(x, faces, keep)
        if keep == "largest":
            raise ValueError("keep='largest' is for method='stuffing'; 'ftetwild' keeps all bodies")
        return _warn_of_volume(_ftetwild(x, faces, spacing, tolerance), x, faces)
    if tolerance is not None:
        raise ValueError(
            "tolerance is for method='ftetwild'; 'stuffing' has no bound, leave it out"
        )
    distance = SurfaceDistance(surface)
    bounds = [distance.x.min(axis=0).tolist(), distance.x.max(axis=0).tolist()]

    def inside(first: Array, counts: IntArray) -> np.ndarray:
        return grid_inside(distance.x, distance.faces, first, spacing, counts)

    keep = _choose_bodies(distance.x, distance.faces, keep)
    filled = fill(lambda p: distance(p.numpy()), bounds, spacing, keep, inside)
    return _warn_of_volume(filled, distance.x, distance.faces)


def _warn_of_volume(mesh: Filled, x: Array, faces: IntArray) -> Filled:
    """The mesh; a warning where it does not weigh what the surface encloses."""
    more = float(total_volume(mesh)) / enclosed_volume(x, faces) - 1.0
    if abs(more) > VOLUME_ERROR:
        warn(
            f"the mesh has {100.0 * abs(more):.2g} % {'more' if more > 0 else 'less'} volume, and "
            "so mass, than its surface encloses; a smaller spacing brings them together",
            stacklevel=3,
        )
    return mesh


def _choose_bodies(x: Array, faces: IntArray, keep: str | None) -> str:
    """Which bodies are filled; several need a choice, so that none is lost in silence."""
    bodies = count_bodies(x, faces)
    if keep is not None:
        return require_choice("keep", keep, ["largest", "all"])
    if bodies > 1:
        raise MeshError(
            f"the surface encloses {bodies} bodies apart from each other: give keep='all' or "
            "keep='largest', or take one of surface.split()"
        )
    return "largest"


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


_BUDGET = 4_000_000
_TRIES = 5


def grid_inside(x: Array, faces: IntArray, first: Array, spacing: float, counts: IntArray) -> Array:
    """Points ``first + spacing * (i, j, k)`` inside a closed surface.

    The points of a column (i, j) are inside after an odd number of crossings. Columns are moved
    sideways by 1e-6 of the spacing, so that none runs through an edge.

    Args:
        x: Surface vertices, (V, 3) [m].
        faces: Triangles, (F, 3), closed.
        first: Point (0, 0, 0), (3,) [m].
        spacing: Distance of neighbors [m].
        counts: Number of points along each axis, (3,).

    Returns:
        (nx, ny, nz) bool.
    """
    rng = np.random.default_rng(0)
    for _ in range(_TRIES):
        shift = spacing * 1e-6 * rng.uniform(-1.0, 1.0, 2)
        column, height = _crossings(x, faces, first[:2] + shift, spacing, counts[:2])
        level = np.ceil((height - first[2]) / spacing)  # first k above the crossing
        level = np.clip(level, 0, counts[2]).astype(np.int64)
        size = int(counts[0] * counts[1])
        toggles = np.bincount(
            column * (counts[2] + 1) + level, minlength=size * int(counts[2] + 1)
        ).reshape(size, -1)
        crossed = np.cumsum(toggles, axis=1) & 1
        if not crossed[:, -1].any():  # every column leaves as often as it enters
            return crossed[:, :-1].astype(bool).reshape(counts.tolist())
    raise MeshError(
        "the surface is not closed seen along z: some lines enter it without leaving; merge close "
        "vertices, for example with MeshLab's 'Merge Close Vertices'"
    )


def _crossings(
    x: Array, faces: IntArray, first: Array, spacing: float, counts: IntArray
) -> tuple[IntArray, Array]:
    """Columns that triangles cross, and at which height: (C,) and (C,) [m]."""
    corners = x[faces]
    flat = (corners[..., :2] - first) / spacing  # columns are at whole numbers
    low = np.clip(np.ceil(flat.min(axis=1)), 0, counts).astype(np.int64)
    high = np.clip(np.floor(flat.max(axis=1)) + 1, 0, counts).astype(np.int64)
    span = np.maximum(high - low, 0)
    num = span.prod(axis=1)
    columns, heights = [], []
    start = 0
    ends = np.cumsum(num)
    while start < len(faces):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _BUDGET)))
        tri = np.repeat(np.arange(start, stop), num[start:stop])
        rank = np.arange(len(tri)) + done - (ends[tri] - num[tri])
        i = low[tri, 0] + rank // np.maximum(span[tri, 1], 1)
        j = low[tri, 1] + rank % np.maximum(span[tri, 1], 1)
        hit, z = _heights(flat[tri], corners[tri, :, 2], np.stack([i, j], axis=1))
        columns.append((i * counts[1] + j)[hit])
        heights.append(z[hit])
        start = stop
    return np.concatenate(columns), np.concatenate(heights)


def _heights(flat: Array, z: Array, points: IntArray) -> tuple[np.ndarray, Array]:
    """Is each point inside its triangle (P, 3, 2), and the triangle's height there.

    Both neighbors of an edge compute its sign from the same two numbers in the same order, so a
    point never falls between them.
    """
    p = points.astype(np.float64)
    area = []
    for c in range(3):
        a, b = flat[:, (c + 1) % 3], flat[:, (c + 2) % 3]
        swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
        lo, hi = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
        d, q = hi - lo, p - lo
        area.append(np.where(swap, -1.0, 1.0) * (d[:, 0] * q[:, 1] - d[:, 1] * q[:, 0]))
    w = np.stack(area, axis=1)
    hit = np.asarray((w > 0).all(axis=1) | (w < 0).all(axis=1))
    total = w.sum(axis=1)
    return hit, (w * z).sum(axis=1) / np.where(total == 0, 1.0, total)
