"""A pinhole camera from points whose places are known, clicked in one picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import rq
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from diffsim.core.arrays import Array

_TURNED = np.diag([-1.0, 1.0, -1.0])  # computer vision looks along +z with v down; here along -z


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
    middle = 0.5 * np.asarray(size_px, np.float64)
    found = [
        _refine_camera(start, places, pixels - middle)
        for start in _starts(places, pixels - middle, float(size_px[0]))
    ]
    best = min(found, key=lambda f: float(np.square(f.fun).sum()))
    rotation = Rotation.from_rotvec(best.x[1:4]).as_matrix()
    return {
        "alpha_px": float(np.exp(best.x[0])),
        "R": (_TURNED @ rotation).tolist(),
        "T_m": (_TURNED @ best.x[4:]).tolist(),
        "reprojection_rms_px": float(np.sqrt(2.0 * np.mean(np.square(best.fun)))),
    }


def _starts(places: Array, pixels: Array, width: float) -> list[Array]:
    """First guesses of log(focal length), rotation vector and shift.

    The linear camera through all points (DLT; Hartley and Zisserman, section 7.1), with the focal
    length that it has and with those of usual lenses: of few points, clicked coarsely, it is poor.
    """
    center, size = places.mean(0), places.std()
    scale = np.sqrt(np.mean(np.square(pixels)))
    p = np.column_stack([(places - center) / size, np.ones(len(places))])
    none = np.zeros_like(p)
    u, v = (pixels / scale).T[:, :, None]
    rows = np.vstack([np.hstack([p, none, -u * p]), np.hstack([none, p, -v * p])])
    camera = np.linalg.svd(rows)[2][-1].reshape(3, 4)
    camera *= np.sign(np.median(p @ camera[2]))  # the points lie in front
    upper, turn = rq(camera[:, :3])
    signs = np.sign(np.diag(upper))
    upper, turn = upper * signs, signs[:, None] * turn
    if np.linalg.det(turn) < 0.0:
        turn = -turn
    usual = (0.7 * width, 1.2 * width, 3.0 * width)
    lengths = [scale * 0.5 * (upper[0, 0] + upper[1, 1]) / upper[2, 2], *usual]
    vector = Rotation.from_matrix(turn).as_rotvec()
    out = []
    for length in lengths:
        across = (turn @ (places - center).T).T[:, :2].std()
        depth = length * across / pixels.std()
        shift = np.append(pixels.mean(0) / length * depth, depth) - turn @ center
        out.append(np.concatenate([[np.log(length)], vector, shift]))
    return out


def _refine_camera(start: Array, places: Array, pixels: Array) -> OptimizeResult:
    """Least squares of the pixels from one first guess."""

    def off(x: Array) -> Array:
        seen = Rotation.from_rotvec(x[1:4]).apply(places) + x[4:]
        depth = np.where(np.abs(seen[:, 2]) > 1e-9, seen[:, 2], 1e-9)
        behind = 1e3 * np.minimum(seen[:, 2], 0.0)  # no camera sees what lies behind it
        flat = np.exp(x[0]) * seen[:, :2] / depth[:, None] - pixels
        return np.concatenate([flat.ravel(), behind])

    found = least_squares(off, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found.fun = found.fun[: pixels.size]
    return found
