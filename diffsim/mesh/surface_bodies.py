"""Which bodies a closed surface encloses: parts apart, cavities, and what cannot be either."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.mesh.components import connected_parts

_MOST_NAMED = 6


def count_bodies(x: Array, faces: IntArray) -> int:
    """Number of bodies apart from each other that a closed surface without crossings encloses.

    A part of the surface within another one is a cavity, and turned inwards.

    Args:
        x: Vertices, (V, 3) [m].
        faces: Triangles, (F, 3), closed.

    Raises:
        MeshError: a part that is turned outwards within a body, or inwards outside of all.
    """
    labels = connected_parts(len(x), faces[:, 0], faces[:, 1])
    labels = np.unique(labels[faces[:, 0]], return_inverse=True)[1]
    parts = [faces[labels == k] for k in range(labels.max() + 1)]
    if len(parts) == 1:
        return 1
    low = np.array([x[p].min(axis=(0, 1)) for p in parts])
    high = np.array([x[p].max(axis=(0, 1)) for p in parts])
    volumes = np.array([enclosed_volume(x, p) for p in parts])
    bodies = 0
    for k, part in enumerate(parts):
        around = np.flatnonzero((low <= low[k]).all(axis=1) & (high >= high[k]).all(axis=1))
        depth = sum(
            np.sign(volumes[i]) * _encloses(x, parts[i], x[part[0]].mean(axis=0))
            for i in around
            if i != k
        )
        wrong = depth != 0 if volumes[k] > 0 else depth != 1
        if wrong:
            first = int(np.flatnonzero(labels == k)[0])
            where = "lies within another one" if volumes[k] > 0 else "is turned inside out"
            raise MeshError(
                f"of {len(parts)} closed parts of the surface, the one of triangle {first}, near "
                f"{place(x[part[0, 0]])} m, {where}: turn the faces of a cavity inwards, of a body "
                "outwards (trimesh: part.invert()), or leave the part out",
                (first,),
            )
        bodies += int(volumes[k] > 0)
    return bodies


def place(point: Array) -> str:
    """A point for a message."""
    return f"({', '.join(f'{v:.4g}' for v in point)})"


def refuse_crossings(x: Array, faces: IntArray, crossings: IntArray) -> None:
    """Refuse a surface whose triangles cross, with the first of them.

    Args:
        x: Vertices, (V, 3) [m].
        faces: Triangles, (F, 3).
        crossings: Pairs of triangles that cross, (K, 2).

    Raises:
        MeshError: there are any.
    """
    if not len(crossings):
        return
    pairs = ", ".join(f"{i} and {j}" for i, j in crossings[:_MOST_NAMED].tolist())
    more = ", ..." if len(crossings) > _MOST_NAMED else ""
    raise MeshError(
        f"the surface crosses itself: triangles {pairs}{more}, near "
        f"{place(x[faces[crossings[0, 0]]].mean(axis=0))} m. What is inside is not certain then: "
        "unite bodies that overlap, for example with trimesh.boolean.union(surface.split()) (pip "
        "install manifold3d), or mend it, for example with Blender's 'Remesh'",
        tuple(sorted(set(crossings.ravel().tolist()))),
    )


def enclosed_volume(x: Array, faces: IntArray) -> float:
    """What triangles enclose, (V, 3) [m] and (F, 3), negative if turned inwards [m^3]."""
    return float(np.linalg.det(x[faces] - x[faces[0, 0]]).sum() / 6.0)


def _encloses(x: Array, faces: IntArray, point: Array) -> bool:
    """Whether solid angles add up to a sphere's (van Oosterom and Strackee 1983)."""
    a, b, c = np.moveaxis(x[faces] - point, 1, 0)
    na, nb, nc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    above = np.einsum("nk,nk->n", a, np.cross(b, c))
    dots = [np.einsum("nk,nk->n", u, v) for u, v in ((a, b), (b, c), (c, a))]
    below = na * nb * nc + dots[0] * nc + dots[1] * na + dots[2] * nb
    return bool(abs(np.arctan2(above, below).sum()) > np.pi)
