"""A pinhole camera from points whose places are known, clicked in one picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_TURNED = np.diag([-1.0, 1.0, -1.0])  # OpenCV looks along +z with v down; here along -z with v up


def calibrate(places_m: Array, pixels: Array, size_px: tuple[int, int]) -> dict[str, Any]:
    """Focal length and pose, the principal point in the middle of the picture, no distortion.

    Args:
        places_m: (n, 3) not all in one plane, n >= 6 [m].
        pixels: Places of the same points in the picture, (n, 2) [px].
        size_px: Width and height of the picture.

    Returns:
        "alpha_px", "R" (3, 3), "T_m" (3,) of Y = R p + T, u = u0 + alpha Y0 / Y2,
        v = v0 - alpha Y1 / Y2 (the form of the tennis balls' data set), "reprojection_rms_px".

    Raises:
        ValueError: too few points, or all in one plane.
    """
    from diffsim.data.video import opencv

    places, pixels = np.asarray(places_m, np.float64), np.asarray(pixels, np.float64)
    if len(places) < 6 or places.shape[1:] != (3,) or pixels.shape != (len(places), 2):
        raise ValueError(
            f"places_m must be (n, 3) and pixels (n, 2) with n >= 6, got {places.shape} and "
            f"{pixels.shape}"
        )
    if np.linalg.matrix_rank(places - places.mean(0), tol=1e-3) < 3:
        raise ValueError(
            "places_m lie in one plane, from which focal length and distance cannot be told apart; "
            "add points at another height"
        )
    cv2 = opencv()
    width, height = size_px
    guess = np.array([[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]])
    fixed = (
        cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    )
    fixed |= cv2.CALIB_ZERO_TANGENT_DIST
    fixed |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    rms, matrix, _, turns, shifts = cv2.calibrateCamera(
        [places.astype(np.float32)],
        [pixels.astype(np.float32)],
        (width, height),
        guess,
        np.zeros(5),
        flags=fixed,
    )
    rotation, _ = cv2.Rodrigues(turns[0])
    return {
        "alpha_px": float(matrix[0, 0]),
        "R": (_TURNED @ rotation).tolist(),
        "T_m": (_TURNED @ shifts[0]).ravel().tolist(),
        "reprojection_rms_px": float(rms),
    }
