"""Normal densities of coordinates that a linear record tells of, each N(0, 1) beforehand.

With residual r at x and slopes J, log p = -(|r - J v|^2 + |x + v|^2) / 2 of a step v is a parabola:
what is integrated out, or known, leaves one of the others (Bishop, Pattern Recognition and Machine
Learning (2006), 2.3.1 and 3.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from diffsim.core.arrays import Array
from diffsim.identify.whitening import gram_of


@dataclass(frozen=True, eq=False)
class Gaussian:
    """log p = level + slope v - v curvature v / 2 of coordinates v, without powers of 2 pi."""

    curvature: Array  # precision, (n, n)
    slope: Array  # at v = 0, (n,)
    level: float = 0.0  # at v = 0 [nats]

    @classmethod
    def of(cls, jacobian: Array, residual: Array, x: Array | None = None) -> Gaussian:
        """Of steps from a point of coordinates that are N(0, 1) beforehand.

        Args:
            jacobian: Slopes of the record, (N, n), whitened.
            residual: Record less simulation at the point, (N,), whitened.
            x: The point, (n,); None: zero, so that steps are the coordinates.
        """
        at = np.zeros(jacobian.shape[1]) if x is None else x
        square = float(residual @ residual + at @ at)
        curvature = gram_of(jacobian) + np.eye(len(at))
        return cls(curvature, jacobian.T @ residual - at, -0.5 * square)

    def solve(self, right: Array) -> Array:
        """Columns (n, K), or one (n,), over the curvature."""
        return np.asarray(linalg.cho_solve(self._factor, right, check_finite=False))

    def whitened(self, right: Array) -> Array:
        """Columns (n, K), or one (n,), over the root L of the curvature L L'."""
        return np.asarray(linalg.solve_triangular(self._factor[0], right, lower=True))

    @cached_property
    def mean(self) -> Array:
        """Where the density is largest, (n,)."""
        return self.solve(self.slope)

    @cached_property
    def covariance(self) -> Array:
        """Inverse of the curvature, (n, n)."""
        return self.solve(np.eye(len(self.slope)))

    @cached_property
    def half_log_det(self) -> float:
        """Half the logarithm of the curvature's determinant [nats]."""
        return float(np.log(np.diag(self._factor[0])).sum())

    @property
    def nats(self) -> float:
        """Logarithm of the integral over all coordinates, their evidence [nats]."""
        return self.level + 0.5 * float(self.slope @ self.mean) - self.half_log_det

    def given(self, known: Sequence[int], values: Array) -> Gaussian:
        """The other coordinates where some are known, (num_known,)."""
        at = list(known)
        rest = [k for k in range(len(self.slope)) if k not in at]
        inner = self.curvature[np.ix_(at, at)] @ values
        return Gaussian(
            self.curvature[np.ix_(rest, rest)],
            self.slope[rest] - self.curvature[np.ix_(rest, at)] @ values,
            self.level + float(values @ (self.slope[at] - 0.5 * inner)),
        )

    def left_to(self, cross: Array, gram: Array, slope: Array) -> tuple[Array, Array]:
        """Parabola of the misfit over further columns G, whatever these coordinates are.

        Args:
            cross: J'G, (n, K).
            gram: G'G, (K, K).
            slope: G'r, (K,).

        Returns:
            What is left of ``gram`` and of ``slope``.
        """
        taken = self.solve(cross)
        return gram - cross.T @ taken, slope - taken.T @ self.slope

    @cached_property
    def _factor(self) -> tuple[Array, bool]:
        return linalg.cho_factor(self.curvature, lower=True)
