"""One Gaussian: coordinates with the prior N(0, 1) and whitened samples r = J x + N(0, 1).

    precision  H = J'J + 1,  mean  m = H^-1 J'r,  -2 ln evidence = r'r - m'J'r + ln det H

Nothing but H, J'r and r'r is kept, so that parts of long records add up, and leave again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Gaussian:
    """Posterior of coordinates, by sums over the samples that were seen.

    Attributes:
        gram: J'J, (n, n).
        score: J'r, (n,).
        power: r'r.
        num_samples: Length of r.
    """

    gram: Array
    score: Array
    power: float
    num_samples: int

    @staticmethod
    def of(jacobian: Array, residual: Array) -> Gaussian:
        """From whitened slopes and samples.

        Args:
            jacobian: J, (N, n).
            residual: r, (N,).
        """
        gram, score = jacobian.T @ jacobian, jacobian.T @ residual
        return Gaussian(gram, score, float(residual @ residual), len(residual))

    def __add__(self, other: Gaussian) -> Gaussian:
        """With the samples of another one."""
        count = self.num_samples + other.num_samples
        return Gaussian(
            self.gram + other.gram, self.score + other.score, self.power + other.power, count
        )

    def without(self, part: Gaussian) -> Gaussian:
        """Without samples that are among its own.

        Args:
            part: These samples alone.
        """
        count = self.num_samples - part.num_samples
        return Gaussian(
            self.gram - part.gram, self.score - part.score, self.power - part.power, count
        )

    @cached_property
    def _factor(self) -> Any:
        return linalg.cho_factor(self.gram + np.eye(len(self.gram)), lower=True)

    @property
    def mean(self) -> Array:
        """(n,)."""
        return self.solve(self.score)

    @property
    def covariance(self) -> Array:
        """(n, n)."""
        return self.solve(np.eye(len(self.gram)))

    def solve(self, right: Array) -> Array:
        """H^-1 times columns, (n,) or (n, k)."""
        if not len(self.gram):
            return np.zeros_like(right)
        return np.asarray(linalg.cho_solve(self._factor, right))

    @property
    def log_evidence(self) -> float:
        """ln p(r) + N/2 ln(2 pi) [nats]."""
        log_det = 2.0 * float(np.log(np.diag(self._factor[0])).sum()) if len(self.gram) else 0.0
        return -0.5 * (self.power - float(self.score @ self.mean) + log_det)

    def marginal(self, idx: Sequence[int]) -> tuple[Array, Array]:
        """Mean and covariance of some coordinates, the others being what they may be."""
        return self.mean[list(idx)], self.covariance[np.ix_(list(idx), list(idx))]

    def given(self, idx: Sequence[int], values: Array) -> Gaussian:
        """The other coordinates where some are known.

        Args:
            idx: Coordinates that are known, (k,).
            values: What they are, (k,).
        """
        known = list(idx)
        rest = [i for i in range(len(self.gram)) if i not in set(known)]
        inside = self.gram[np.ix_(known, known)]
        power = self.power - 2.0 * float(values @ self.score[known])
        return Gaussian(
            self.gram[np.ix_(rest, rest)],
            self.score[rest] - self.gram[np.ix_(rest, known)] @ values,
            power + float(values @ inside @ values),
            self.num_samples,
        )

    def gain(self, cross: Array, gram: Array, score: Array) -> tuple[Array, Array]:
        """What further columns D would do where the coordinates follow them.

        Args:
            cross: J'D, (n, k).
            gram: D'D, (k, k).
            score: D'r, (k,).

        Returns:
            D'PD and D'Pr with P = 1 - J H^-1 J': sizes a of the columns lower r'r with the prior's
            share by 2 a'D'Pr - a'D'PD a.
        """
        absorbed = self.solve(cross)
        return gram - cross.T @ absorbed, score - absorbed.T @ self.score
