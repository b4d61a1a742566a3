"""Maneuvers of the virtual multicopter: place in NED [m] and yaw [rad] over time [s].

No rotor comes nearer to the ground than its radius: below, no form of the ground effect is known.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Path = Callable[[float], tuple[Array, float]]


def _smooth(t: float, start: float, length: float) -> float:
    """From 0 to 1 with continuous acceleration."""
    s = min(max((t - start) / length, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s * s)


def _hover_yaw(t: float) -> tuple[Array, float]:
    return np.array([0.0, 0.0, -1.0]), 1.5 * (_smooth(t, 0.5, 1.2) - _smooth(t, 2.3, 1.2))


def _sprint(t: float) -> tuple[Array, float]:
    out = _smooth(t, 0.2, 1.7) - _smooth(t, 2.1, 1.7)
    return np.array([3.5 * out, 0.5 * np.sin(3.0 * t), -1.0]), 0.8 * _smooth(t, 0.0, 4.0)


def _climb(t: float) -> tuple[Array, float]:
    height = 0.45 + 1.8 * (_smooth(t, 0.5, 1.2) - _smooth(t, 2.2, 1.3))
    return np.array([0.4 * np.sin(2.0 * t), 0.0, -height]), 0.3


def _figure_eight(t: float) -> tuple[Array, float]:
    s = 1.3 * t - (1.0 - np.exp(-1.3 * t))  # starts from rest
    return np.array([1.5 * np.sin(s), 0.7 * np.sin(2.0 * s), -0.9 - 0.4 * np.sin(s)]), -0.5 * t


MANEUVERS: dict[str, Path] = {
    "hover_yaw": _hover_yaw,
    "sprint": _sprint,
    "climb": _climb,
    "figure_eight": _figure_eight,
}
