"""Quaternions (w, x, y, z), world from body, for the virtual multicopter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def matrix(q: Array) -> Array:
    """Rotation matrix, world from body."""
    w, x, y, z = (q / np.sqrt(q @ q)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def product(p: Array, q: Array) -> Array:
    """Hamilton product of two quaternions."""
    a, b, c, d = p.tolist()
    e, f, g, h = q.tolist()
    return np.array(
        [
            a * e - b * f - c * g - d * h,
            a * f + b * e + c * h - d * g,
            a * g - b * h + c * e + d * f,
            a * h + b * g - c * f + d * e,
        ]
    )


def cross(a: Array, b: Array) -> Array:
    """np.cross of two vectors, ten times as fast."""
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def angles(q: Array) -> Array:
    """Roll, pitch, yaw."""
    rot = matrix(q)
    return np.array(
        [
            np.arctan2(rot[2, 1], rot[2, 2]),
            -np.arcsin(np.clip(rot[2, 0], -1.0, 1.0)),
            np.arctan2(rot[1, 0], rot[0, 0]),
        ]
    )
