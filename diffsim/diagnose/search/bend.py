"""What Gauss-Newton leaves out of a misfit's curvature, learned from slopes at two points.

Half of |r|^2 with r = y - S curves by J'J - sum_i r_i d2S_i. Where the misfit stays large and the
response bends, the sum matters: without it steps creep along the valley. Every time slopes are
simulated again they show it along the way that was gone, at no cost.

Source: Dennis, Gay and Welsch, An adaptive nonlinear least-squares algorithm, ACM TOMS 7 (1981)
348: the update of the second-order part with its sizing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]
NO_CHANGE = 1e-8  # cosine of step and change of the gradient below which nothing is learned
LEAST = 1.0  # curvature of the misfit with its prior: a step is to lead down


class Point(NamedTuple):
    """A point with slopes that were simulated there.

    Attributes:
        scaled: Coordinates, (n,).
        residual: r, (num_valid,).
        slopes: J = dS/du, (num_valid, n).
    """

    scaled: Array
    residual: Array
    slopes: Array


def learned(bend: Array, before: Point, here: Point) -> Array:
    """The second-order part after another point, (n, n), symmetric.

    Args:
        bend: The part so far; zeros at first.
        before, here: The last two points with slopes of their own.
    """
    step = here.scaled - before.scaled
    moved = before.slopes.T @ before.residual - here.slopes.T @ here.residual
    along = float(moved @ step)
    if not abs(along) > NO_CHANGE * linalg.norm(moved) * linalg.norm(step):
        return bend
    second = (before.slopes - here.slopes).T @ here.residual
    known = float(step @ bend @ step)
    if known != 0.0:  # of another time, when the residual may have been larger
        bend = bend * min(1.0, abs(float(step @ second) / known))
    missing = second - bend @ step
    cross = np.outer(missing, moved) / along
    square = float(step @ missing) / along**2
    return np.asarray(bend + cross + cross.T - square * np.outer(moved, moved))


def definite(gram: Array, bend: Array) -> Array:
    """J'J and the second-order part together, (n, n), so that with the prior's unit matrix every
    direction curves upwards."""
    if not bend.any():
        return gram
    one = np.eye(len(gram))
    values, vectors = linalg.eigh(gram + bend + one)
    if values[0] >= LEAST:
        return np.asarray(gram + bend)
    return np.asarray((vectors * np.maximum(values, LEAST)) @ vectors.T - one)
