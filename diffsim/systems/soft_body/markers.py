"""Markers on a mesh: places of points that are fixed to a face of a body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def marker_weights(face_points: Array, marker_points: Array) -> Array:
    """Weights w (num_markers, n) with place(marker) = w @ place(face nodes).

    The markers sit on stubs outside the body. The tip face is followed by the best affine map
    (least squares over its nodes), which carries any rigid motion of the face exactly; markers
    are attached to that map. Only the in-plane part of the affine map is used, so markers must
    lie in the plane of the face.

    Args:
        face_points: (n, 3) rest places of the tip face's nodes [m], all at one x.
        marker_points: (num_markers, 3) nominal places [m].

    Raises:
        ValueError: the face is not a plane x = const, has fewer than three nodes off one line,
            or a marker is more than 1 mm out of its plane.
    """
    level = float(face_points[:, 0].mean())
    if np.abs(face_points[:, 0] - level).max() > 1e-6:
        raise ValueError(
            f"face_points must share one x, got a spread of {np.ptp(face_points[:, 0]):g} m"
        )
    off = float(np.abs(marker_points[:, 0] - level).max())
    if off > 1e-3:
        raise ValueError(f"markers must lie within 1 mm of the face x = {level:g} m, got {off:g} m")
    basis = np.column_stack([np.ones(len(face_points)), face_points[:, 1:]])
    if np.linalg.matrix_rank(basis) < 3:
        raise ValueError("face_points must hold three nodes that are not on one line")
    at = np.column_stack([np.ones(len(marker_points)), marker_points[:, 1:]])
    return at @ np.linalg.pinv(basis)
