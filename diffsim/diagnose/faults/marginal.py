"""Scatter of a group integrated out: what its samples say of the rest.

With residuals linear in z = (rest, scatter) and scatter ~ N(0, spread^2), the integral over the
scatter is Gaussian: a Schur complement for the information on the rest, and a determinant.
Bishop, Pattern Recognition and Machine Learning (2006), 2.3.1 and 3.5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array
from diffsim.identify.gaussian import Gaussian


@dataclass(frozen=True, eq=False)
class Priors:
    """Normal priors of some coordinates, one for each of several draws of what they hang on."""

    precision: Array  # (num_draws, m, m) inverse covariances
    slope: Array  # (num_draws, m) precision times mean
    level: Array  # (num_draws,) logarithm of the density at 0, without its power of 2 pi

    @classmethod
    def of(cls, precision: Array, mean: Array) -> Priors:
        """Priors by their precision, (num_draws, m, m), and their mean, (num_draws, m)."""
        slope = (precision @ mean[..., None])[..., 0]
        level = 0.5 * np.linalg.slogdet(precision)[1] - 0.5 * np.sum(mean * slope, axis=-1)
        return cls(precision, slope, np.asarray(level))


def without(
    curvature: Array, slope: Array, level: float, gone: slice, priors: Priors
) -> list[Gaussian]:
    """Integrate coordinates out that have a Gaussian prior, for each draw of it.

    Args:
        curvature: (n, n) of log p = level + slope z - z curvature z / 2.
        slope: (n,).
        level: Log density at 0.
        gone: The m coordinates that are integrated out: the first or the last ones.

    Returns:
        Information on the coordinates that stay, in their order, for each draw.

    Raises:
        LinAlgError: what is integrated out has no definite information.
    """
    stay = slice(gone.stop, None) if not gone.start else slice(0, gone.start)
    cross = curvature[gone, stay]
    pull = slope[gone] + priors.slope  # (num_draws, m)
    inner = curvature[gone, gone] + priors.precision
    half_log_det = np.log(np.linalg.cholesky(inner).diagonal(axis1=1, axis2=2)).sum(-1)
    wanted = np.concatenate(
        [np.broadcast_to(cross, (len(inner), *cross.shape)), pull[..., None]], 2
    )
    shared = np.linalg.solve(inner, wanted)
    levels = level + priors.level + 0.5 * np.sum(pull * shared[..., -1], axis=-1) - half_log_det
    curvatures = curvature[stay, stay] - cross.T @ shared[..., :-1]
    slopes = slope[stay] - shared[..., -1] @ cross
    return [Gaussian(c, s, float(x)) for c, s, x in zip(curvatures, slopes, levels, strict=True)]
