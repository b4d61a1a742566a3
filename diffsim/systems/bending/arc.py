"""The arc's shape from the markers alone: where they are at a bend, whatever made it bend."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from diffsim.data.study import Run
from diffsim.systems.bending.scene import rest_of

Array = NDArray[np.float64]
SEEN = 0.02  # [rad] of bend, from which a sample says something


def calibrated_arc(
    runs: Sequence[Run], axes: tuple[int, int, int], length: float, center_toward: float
) -> dict[str, float]:
    """Shape, neutral axis and direction from the turn and the shift of a face of three markers.

    The turn of the face is measured by its normal, so that no pressure enters.

    Args:
        runs: Runs to fit, with three markers each.
        axes: Indices of the laboratory's axes along and across the body.
        length: Length of the arc [m].
        center_toward: Distance of the markers' mean from the face's center, towards the bend [m].

    Returns:
        The kinematic parameters of the scene, and "misfit", rms [m].
    """
    angles, along, away, ways = [], [], [], []
    for run in runs:
        rest, marks = rest_of(run), run.measured.reshape(-1, 3, 3)
        marks = marks[np.isfinite(marks).all(axis=(1, 2))]
        angle = np.arccos(np.clip(_normal(marks) @ _normal(rest), -1.0, 1.0))
        shift = (marks.mean(axis=1) - rest.mean(axis=0))[angle > SEEN]
        a, b, c = axes
        angles.append(angle[angle > SEEN])
        along.append(shift[:, a])
        away.append(np.hypot(shift[:, b], shift[:, c]))
        ways.append(shift[:, [b, c]].sum(axis=0))
    q, x, y = (np.concatenate(v) for v in (angles, along, away))

    def residual(p: Array) -> Array:
        shape, neutral = p
        dx = length * (np.sin(q) / q - 1.0) + neutral * q - center_toward * np.sin(q)
        dy = 2.0 * length * shape * (1.0 - np.cos(q)) / q + center_toward * (np.cos(q) - 1.0)
        return np.concatenate([dx - x, dy - y])

    solution = optimize.least_squares(residual, [0.5, 0.01])
    way = np.sum(ways, axis=0)
    return {
        "length": length,
        "center_toward": center_toward,
        "shape": float(solution.x[0]),
        "neutral_axis": float(solution.x[1]),
        "direction": float(np.arctan2(way[1], way[0])),
        "misfit": float(np.sqrt(np.mean(solution.fun**2))),
    }


def _normal(marks: Array) -> Array:
    """Unit normals of triangles (..., 3 markers, 3)."""
    first, second = marks[..., 1, :] - marks[..., 0, :], marks[..., 2, :] - marks[..., 0, :]
    normal = np.cross(first, second)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
