"""What a mesh must satisfy before anything is computed on it; every refusal says how to mend it."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.errors import MeshError
from diffsim.mesh.congruence import congruence_classes
from diffsim.mesh.reference import (
    HEX_CORNERS,
    HEX_FROM_VTK,
    HEX_GAUSS,
    HEX_MIRROR,
    det3,
    hex_jacobians,
)

DEGENERATE = 1e-10
"""Smallest det J (hex) or 6 V (tet) accepted, over the cube of the longest edge vector [-]."""

COINCIDENT = 1e-9
"""Nodes closer than this times the diagonal of the bounding box count as one place."""

SIDES = (1e-88, 1e100)
"""Longest sides of meshes [m] whose volumes, by both limits above, have room in float64."""

_CHUNK = 1 << 16


def check_indices(elements: IntArray, num_nodes: int, plural: str) -> None:
    """No elements, indices out of range, and indices used twice in one element."""
    if len(elements) == 0:
        raise MeshError(f"the mesh has no elements: {plural} is empty; pass at least one element")
    outside = np.flatnonzero(((elements < 0) | (elements >= num_nodes)).any(axis=1))
    if len(outside):
        raise MeshError(
            f"{plural} must hold indices of x_rest in [0, {num_nodes}), but "
            f"{_count(len(outside), len(elements), 'elements do', 'element does')} not: "
            f"{_first(outside)}; check that numbering starts at 0",
            _indices(outside),
        )
    ordered = np.sort(elements, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if len(repeated):
        raise MeshError(
            f"{_count(len(repeated), len(elements), 'elements use', 'element uses')} a node more "
            f"than once: {_first(repeated)}; drop them with diffsim.mesh.remove_degenerate(x_rest, "
            f"{plural})",
            _indices(repeated),
        )


def check_size(x: Array) -> None:
    """Volumes that float64 can hold: smaller ones would be zero without a word."""
    longest = float((x.max(axis=0) - x.min(axis=0)).max())
    if 0.0 < longest < SIDES[0] or longest > SIDES[1]:
        raise MeshError(
            f"the mesh's longest side must lie between {SIDES[0]:g} and {SIDES[1]:g}, where "
            f"float64 has room for volumes, got {longest:g}; choose another unit of length"
        )


def check_nodes(x: Array, elements: IntArray, plural: str) -> None:
    """Nodes that belong to no element, and nodes that lie in the same place."""
    unused = np.flatnonzero(np.bincount(elements.reshape(-1), minlength=len(x)) == 0)
    if len(unused):
        raise MeshError(
            f"{_count(len(unused), len(x), 'nodes belong', 'node belongs')} to no element: "
            f"{_first(unused)}; drop them with diffsim.mesh.remove_unreferenced_nodes(x_rest, "
            f"{plural})",
            _indices(unused),
        )
    pairs = coincident_pairs(x, COINCIDENT * bounding_diagonal(x))
    if len(pairs):
        shown = ", ".join(f"{a} and {b}" for a, b in pairs[:4])
        raise MeshError(
            f"{len(pairs)} pair{'s' * (len(pairs) > 1)} of nodes coincide: {shown}"
            f"{', ...' * (len(pairs) > 4)}; merge them with "
            f"diffsim.mesh.merge_duplicate_nodes(x_rest, {plural})",
            _indices(np.unique(pairs)),
        )


def check_hexes(x: Array, hexes: IntArray) -> None:
    """det J > 0 at the eight corners and the eight Gauss points."""
    smallest = smallest_hex_jacobian(x, hexes)
    bad = np.flatnonzero(smallest <= DEGENERATE)
    if len(bad) == 0:
        return
    flipped = smallest_hex_jacobian(x, hexes[bad][:, HEX_MIRROR])
    from_vtk = smallest_hex_jacobian(x, hexes[bad][:, HEX_FROM_VTK])
    if (flipped > DEGENERATE).all():
        hint = "they are mirrored: mend with diffsim.mesh.flip_inverted(x_rest, hexes)"
    elif (from_vtk > DEGENERATE).all():
        hint = "the nodes are in VTK order: use hexes[:, diffsim.mesh.HEX_FROM_VTK]"
    else:
        hint = "move their nodes, or drop them with diffsim.mesh.remove_degenerate(x_rest, hexes)"
    kind = "inverted" if (smallest[bad] < -DEGENERATE).all() else "inverted or degenerate"
    raise MeshError(
        f"{_count(len(bad), len(hexes), 'elements are', 'element is')} {kind} (det J <= 0 at a "
        f"corner or Gauss point): {_first(bad)}; {hint}",
        _indices(bad),
    )


def check_tets(x: Array, tets: IntArray) -> None:
    """V = det[x1-x0, x2-x0, x3-x0] / 6 > 0."""
    volume = relative_tet_volume(x, tets)
    bad = np.flatnonzero(volume <= DEGENERATE)
    if len(bad) == 0:
        return
    if (volume[bad] < -DEGENERATE).all():
        kind = "inverted (volume < 0, left-handed order)"
        hint = "mend with diffsim.mesh.flip_inverted(x_rest, tets)"
    else:
        kind = "inverted or degenerate (volume <= 0)"
        hint = "drop flat ones with diffsim.mesh.remove_degenerate(x_rest, tets)"
    raise MeshError(
        f"{_count(len(bad), len(tets), 'elements are', 'element is')} {kind}: {_first(bad)}; "
        f"{hint}",
        _indices(bad),
    )


def smallest_hex_jacobian(x: Array, hexes: IntArray) -> Array:
    """Least det J over corners and Gauss points / (longest edge vector)^3, (E,) [-]."""
    representative, class_idx = congruence_classes(x, hexes)
    points = np.concatenate([HEX_CORNERS.astype(np.float64), HEX_GAUSS])
    smallest = np.empty(len(representative))
    for start in range(0, len(representative), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        corners = x[hexes[representative[chunk]]]
        jacobians = hex_jacobians(corners, points)
        longest = np.linalg.norm(jacobians, axis=2).max(axis=(1, 2))
        smallest[chunk] = det3(jacobians).min(axis=1) / np.maximum(longest, 1e-300) ** 3
    return smallest[class_idx]


def relative_tet_volume(x: Array, tets: IntArray) -> Array:
    """6 V / (longest edge from node 0)^3, (E,) [-]."""
    edges = x[tets[:, 1:]] - x[tets[:, :1]]
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    return det3(edges) / np.maximum(longest, 1e-300) ** 3


def bounding_diagonal(x: Array) -> float:
    """Length of the diagonal of the bounding box [m]."""
    return float(np.linalg.norm(x.max(axis=0) - x.min(axis=0))) if len(x) else 0.0


def coincident_pairs(x: Array, distance: float) -> IntArray:
    """Some pairs of nodes at most ``distance`` apart, (P, 2); empty only when there are none.

    Nodes are sorted along an oblique line, where neighbors in space are neighbors in the order.
    """
    along = x @ np.array([0.5773, 0.7071, 0.4082])  # length at most 1: no pair is overlooked
    order = np.argsort(along)
    along = along[order]
    for step in range(1, len(x)):
        near = np.flatnonzero(along[step:] - along[:-step] <= distance)
        if len(near) == 0:
            break
        first, second = order[near], order[near + step]
        hit = np.linalg.norm(x[first] - x[second], axis=1) <= distance
        if hit.any():
            return np.sort(np.stack([first[hit], second[hit]], axis=1), axis=1).astype(np.int64)
    return np.zeros((0, 2), np.int64)


def _count(bad: int, total: int, plural: str, singular: str) -> str:
    noun, verb = (singular if total == 1 else plural).split(" ", 1)
    if total > 1 and bad == 1:
        verb = singular.split(" ", 1)[1]
    return f"{bad} of {total} {noun} {verb}"


def _first(indices: IntArray, limit: int = 8) -> str:
    shown = ", ".join(str(int(i)) for i in indices[:limit])
    return shown + (", ..." if len(indices) > limit else "")


def _indices(indices: IntArray) -> tuple[int, ...]:
    return tuple(int(i) for i in indices[:1000])
