"""Take in a closed triangle surface: a trimesh or a file; refuse holes, say where they are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.mesh.crossings import crossing_triangles
from diffsim.mesh.surface_bodies import enclosed_volume, refuse_crossings
from diffsim.mesh.surface_check import check_indices

if TYPE_CHECKING:
    import trimesh


SurfaceLike: TypeAlias = "trimesh.Trimesh | str | Path"
SIDES = (1e-70, 1e70)
"""Least and largest side of a surface [m]: squares of areas must be numbers."""


def closed_surface(surface: SurfaceLike, *, may_cross: bool = False) -> tuple[Array, IntArray]:
    """Vertices (V, 3) [m] and triangles (F, 3), closed and oriented outwards.

    Vertices in the same place are merged (STL files store each triangle on its own) and triangles
    that collapse by that are dropped.

    Args:
        surface: A trimesh or the path of a file.
        may_cross: Whether triangles may run through each other: of what was asked before.

    Raises:
        TypeError: neither a trimesh nor a path.
        MeshError: faces of vertices that there are not, open edges, edges of more than two
            triangles, inconsistent orientation, no volume, triangles that cross, a size whose
            areas have no squares.
    """
    import trimesh

    if isinstance(surface, str | Path):
        from diffsim.mesh.files import load_surface

        surface = load_surface(surface)
    if not isinstance(surface, trimesh.Trimesh):
        raise TypeError(
            "surface must be a trimesh.Trimesh or the path of a surface file, got "
            f"{type(surface).__name__}"
        )
    x = np.asarray(surface.vertices, np.float64)
    if len(surface.faces) == 0:
        raise MeshError("the surface has no triangles")
    if not np.isfinite(x).all():
        raise MeshError("the surface has vertices that are not finite")
    check_indices(np.asarray(surface.faces, np.int64), x)
    far = float(np.abs(x).max())
    if not SIDES[0] <= far <= SIDES[1]:
        raise MeshError(
            f"the surface must reach {SIDES[0]:g} to {SIDES[1]:g} m from the origin, where squares "
            f"of areas are numbers, got {far:.3g} m; check its unit"
        )
    x, inverse = np.unique(x, axis=0, return_inverse=True)
    faces = inverse.reshape(-1)[np.asarray(surface.faces, np.int64)]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _check_closed(faces, len(x))
    volume = enclosed_volume(x, faces)
    extent = x.max(axis=0) - x.min(axis=0)
    if abs(volume) <= 1e-12 * float(extent.max()) ** 3:
        raise MeshError(
            f"the surface encloses no volume ({volume:.3g} m^3): it is flat, or parts that are "
            "turned against each other cancel"
        )
    if not may_cross:
        refuse_crossings(x, faces, crossing_triangles(x, faces))
    return x, faces if volume > 0 else faces[:, ::-1]


def _check_closed(faces: IntArray, num_vertices: int) -> None:
    directed = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs = np.sort(directed, axis=1)
    keys, first, count = np.unique(
        pairs[:, 0] * num_vertices + pairs[:, 1], return_index=True, return_counts=True
    )
    open_edges = first[count == 1]
    if len(open_edges):
        plural = "s" * (len(open_edges) > 1)
        raise MeshError(
            f"the surface is not watertight: {len(open_edges)} open edge{plural} of {len(keys)}, "
            f"in triangles {', '.join(str(int(i) // 3) for i in open_edges[:6])}"
            f"{', ...' * (len(open_edges) > 6)}; close the holes, for example with "
            "trimesh.repair.fill_holes(surface) (pip install networkx), MeshLab's 'Close Holes' or "
            "Blender's '3D-Print: Make Manifold'",
            tuple(int(i) // 3 for i in open_edges[:1000]),
        )
    crowded = first[count % 2 == 1]
    if len(crowded):
        raise MeshError(
            f"the surface is not watertight: {len(crowded)} edges belong to an odd number of "
            "triangles; remove inner walls, for example with MeshLab's 'Remove Non Manifold Edges'",
            tuple(int(i) // 3 for i in crowded[:1000]),
        )
    sign = np.where(directed[:, 0] < directed[:, 1], 1, -1)
    balance = np.zeros(len(keys), np.int64)
    np.add.at(balance, np.searchsorted(keys, pairs[:, 0] * num_vertices + pairs[:, 1]), sign)
    twisted = first[balance != 0]
    if len(twisted):
        raise MeshError(
            f"the surface's triangles are not oriented alike: {len(twisted)} edges are run through "
            "twice in one direction; mend with trimesh.repair.fix_normals(surface) (pip install "
            "networkx)",
            tuple(int(i) // 3 for i in twisted[:1000]),
        )
