"""Scatter of a group integrated out: what its samples say of the rest.

With residuals linear in z = (rest, scatter) and scatter ~ N(0, spread^2), the integral over the
scatter is Gaussian: a Schur complement for the information on the rest, and a determinant.
Bishop, Pattern Recognition and Machine Learning (2006), 2.3.1 and 3.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Information:
    """log p = level + slope x - x curvature x / 2 of some coordinates x.

    Attributes:
        curvature: (n, n) precision.
        slope: (n,).
        level: Logarithm of the density of the samples at x = 0, up to a constant of the samples.
    """

    curvature: Array
    slope: Array
    level: float

    def only(self, keep: Sequence[int]) -> Information:
        """Information where the other coordinates are 0."""
        at = list(keep)
        return Information(self.curvature[np.ix_(at, at)], self.slope[at], self.level)

    @property
    def mean(self) -> Array:
        """Where the density is largest, (n,)."""
        return np.asarray(np.linalg.solve(self.curvature, self.slope))

    @property
    def covariance(self) -> Array:
        """Inverse of the precision, (n, n)."""
        return np.asarray(np.linalg.inv(self.curvature))


def without(
    curvature: Array, slope: Array, level: float, gone: slice, prior: Array, prior_slope: Array
) -> Information:
    """Integrate coordinates out that have a Gaussian prior.

    Args:
        curvature: (n, n) of log p = level + slope z - z curvature z / 2.
        slope: (n,).
        level: Log density at 0.
        gone: The m coordinates that are integrated out: the first or the last ones.
        prior: Their prior precision, (m, m).
        prior_slope: Prior precision times prior mean, (m,).

    Returns:
        Information on the coordinates that stay, in their order.
    """
    stay = slice(gone.stop, None) if not gone.start else slice(0, gone.start)
    inner = curvature[gone, gone] + prior
    cross = curvature[gone, stay]
    pull = slope[gone] + prior_slope
    factor, shared, failed = lapack.dposv(inner, np.column_stack([cross, pull]))
    if failed:
        raise np.linalg.LinAlgError("the information on what is integrated out is not definite")
    inner_log_det = 2.0 * float(np.log(np.diag(factor)).sum())
    out = level + 0.5 * float(pull @ shared[:, -1]) + 0.5 * (_log_det(prior) - inner_log_det)
    if prior_slope.any():
        out -= 0.5 * float(prior_slope @ np.linalg.solve(prior, prior_slope))
    return Information(
        curvature[stay, stay] - cross.T @ shared[:, :-1],
        slope[stay] - cross.T @ shared[:, -1],
        out,
    )


def _log_det(matrix: Array) -> float:
    diagonal = np.diag(matrix)
    if np.count_nonzero(matrix) == len(diagonal):  # nothing beside the diagonal
        return float(np.log(diagonal).sum())
    return float(np.linalg.slogdet(matrix)[1])
