"""Places where a body hangs together only by an edge or a node, and could swing freely."""

from __future__ import annotations

import numpy as np

from diffsim.core.arrays import IntArray
from diffsim.mesh.components import connected_parts
from diffsim.mesh.reference import HEX_EDGES, HEX_FACES, TET_EDGES, TET_FACES
from diffsim.mesh.surface import face_keys


def without_hinges(elements: IntArray, keep_largest: bool) -> IntArray:
    """Drop the smaller side of every hinge, until none is left; the order is kept.

    Args:
        elements: Node indices of one kind, (E, 8) or (E, 4).
        keep_largest: Whether to keep only the largest part that hangs together through faces.
    """
    while len(elements):
        if keep_largest:
            part = connected_parts(len(elements), *_neighbors(elements)[:2])
            elements = elements[part == np.bincount(part).argmax()]
        drop = hinged_elements(elements)
        if not drop.any():
            break
        elements = elements[~drop]
    return elements


def hinged_elements(elements: IntArray) -> np.ndarray:
    """Elements on the smaller side of a hinge, (E,) bool.

    The elements around a node, or around an edge, form fans connected through faces that hold it;
    a second fan makes a hinge. Contact at an edge or a node of two separate parts counts too.
    """
    faces, edges = (HEX_FACES, HEX_EDGES) if elements.shape[1] == 8 else (TET_FACES, TET_EDGES)
    first, second, first_face, second_face = _neighbors(elements)
    size = int(elements.max()) + 1
    edge_of = {frozenset(edge): number for number, edge in enumerate(edges.tolist())}
    face_edges = np.array(
        [[edge_of[frozenset((a, b))] for a, b in zip(f, np.roll(f, -1), strict=True)]
         for f in faces.tolist()]
    )  # fmt: skip
    ends = np.sort(elements[:, edges], axis=2)
    drop = np.zeros(len(elements), bool)
    for keys, face_parts in (
        (elements, faces),
        (ends[..., 0] * size + ends[..., 1], face_edges),
    ):
        a = _sort_by_key(keys, face_parts, first, first_face)
        b = _sort_by_key(keys, face_parts, second, second_face)
        fan = connected_parts(keys.size, a.reshape(-1), b.reshape(-1))
        drop |= _smaller_fans(keys.reshape(-1), fan).reshape(keys.shape).any(axis=1)
    return drop


def _neighbors(elements: IntArray) -> tuple[IntArray, IntArray, IntArray, IntArray]:
    """Pairs of elements that share a face, and the local number of that face in each."""
    faces = HEX_FACES if elements.shape[1] == 8 else TET_FACES
    keys = face_keys(elements[:, faces].reshape(-1, faces.shape[1]))
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    a, b = order[same], order[same + 1]
    return a // len(faces), b // len(faces), a % len(faces), b % len(faces)


def _sort_by_key(
    keys: IntArray, face_parts: IntArray, element: IntArray, face: IntArray
) -> IntArray:
    """Flat indices into ``keys`` of the nodes or edges of faces, ascending by key in each face."""
    local = face_parts[face]
    order = np.argsort(keys[element[:, None], local], axis=1)
    return element[:, None] * keys.shape[1] + np.take_along_axis(local, order, axis=1)


def _smaller_fans(keys: IntArray, fan: IntArray) -> np.ndarray:
    """Which items are in another fan than the largest around their node or edge."""
    fans, first, count = np.unique(fan, return_index=True, return_counts=True)
    order = np.lexsort((fans, -count, keys[first]))  # by node or edge, the largest fan first
    ordered = keys[first][order]
    small = np.zeros(len(fans), bool)
    small[order[1:]] = ordered[1:] == ordered[:-1]
    return small[fan]
