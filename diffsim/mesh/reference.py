"""The reference elements: node order, Gauss points, shape-function derivatives.

Hexahedron on [0, 1]^3 with local node ``a = 4 di + 2 dj + dk`` at (di, dj, dk), so nodes run
000, 001, 010, 011, 100, 101, 110, 111, and N_a(s) = prod_c (s_c if d_c else 1 - s_c).
Tetrahedron with x(s) = x0 + s_1 (x1 - x0) + s_2 (x2 - x0) + s_3 (x3 - x0).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from diffsim.core.arrays import Array, IntArray

HEX_CORNERS: IntArray = np.array([[a >> 2 & 1, a >> 1 & 1, a & 1] for a in range(8)], np.int64)
"""(di, dj, dk) of the eight local nodes, (8, 3)."""

HEX_GAUSS: Array = 0.5 + (HEX_CORNERS - 0.5) / np.sqrt(3.0)
"""2x2x2 Gauss points 1/2 +- 1/(2 sqrt 3) in node order, (8, 3); each has weight 1/8."""

HEX_FACES: IntArray = np.array(
    [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]], np.int64
)
"""Local nodes of the six faces -i, +i, -j, +j, -k, +k, counter-clockwise from outside, (6, 4)."""

HEX_EDGES: IntArray = np.array(
    [[a, a | bit] for bit in (4, 2, 1) for a in range(8) if not a & bit], np.int64
)
"""Local nodes of the twelve edges, (12, 2)."""

HEX_MIRROR: IntArray = np.array([1, 0, 3, 2, 5, 4, 7, 6], np.int64)
"""Node order that mirrors a hexahedron in k, (8,)."""

HEX_FROM_VTK: IntArray = np.array([0, 4, 3, 7, 1, 5, 2, 6], np.int64)
"""``hexes = vtk[:, HEX_FROM_VTK]``; VTK, Abaqus and Gmsh walk around k = 0, then around k = 1."""

VTK_FROM_HEX: IntArray = np.argsort(HEX_FROM_VTK).astype(np.int64)
"""``vtk = hexes[:, VTK_FROM_HEX]``, the inverse."""

TET_FACES: IntArray = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], np.int64)
"""Local nodes of the face opposite to node 0, 1, 2, 3, counter-clockwise from outside, (4, 3)."""

TET_EDGES: IntArray = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], np.int64)
"""Local nodes of the six edges, (6, 2)."""


def hex_shape(points: Array) -> Array:
    """Trilinear shape functions N_a at reference points: (P, 3) -> (P, 8) [-]."""
    s = np.where(HEX_CORNERS[None] == 1, points[:, None], 1.0 - points[:, None])
    return s.prod(axis=2)


def hex_shape_derivatives(points: Array) -> Array:
    """dN_a/ds_c at reference points: (P, 3) -> (P, 8, 3) [-]."""
    s = np.where(HEX_CORNERS[None] == 1, points[:, None], 1.0 - points[:, None])
    sign = 2.0 * HEX_CORNERS - 1.0
    columns = [sign[None, :, c] * np.delete(s, c, axis=2).prod(axis=2) for c in range(3)]
    return np.stack(columns, axis=2)


def hex_jacobians(corners: Array, points: Array) -> Array:
    """J = dx/ds of trilinear hexahedra.

    Args:
        corners: Node positions, (E, 8, 3) [m].
        points: Reference points, (P, 3) [-].

    Returns:
        J[e, p, i, c] = dx_i/ds_c, (E, P, 3, 3) [m].
    """
    flat = np.swapaxes(corners, 1, 2).reshape(-1, 8)
    derivatives = hex_shape_derivatives(points).transpose(1, 0, 2).reshape(8, -1)
    jacobians = (flat @ derivatives).reshape(len(corners), 3, len(points), 3)
    return jacobians.transpose(0, 2, 1, 3)


def det3(m: Any) -> Any:
    """Determinants of (..., 3, 3) matrices, arrays or tensors, by the rule of Sarrus (ten times
    LAPACK's speed)."""
    a, b, c = m[..., 0, :], m[..., 1, :], m[..., 2, :]
    return (
        a[..., 0] * (b[..., 1] * c[..., 2] - b[..., 2] * c[..., 1])
        + a[..., 1] * (b[..., 2] * c[..., 0] - b[..., 0] * c[..., 2])
        + a[..., 2] * (b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0])
    )
