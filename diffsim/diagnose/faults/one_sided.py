"""Known sizes that are of one sign: a rotor that was cut lost thrust, it did not gain any.

What scatters by states is told from what was done on purpose by the sign alone where all groups of
a state were changed. Expectation propagation (Minka, UAI 2001) puts a normal term in the place of
each condition "not below 0", so that mean and variance of the size are those under the condition.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr

from diffsim.core.arrays import Array
from diffsim.diagnose.faults.local import Local

SMALLEST_SHARE = 1e-6  # of a variance that a condition leaves


@dataclass(frozen=True, eq=False)
class Terms:
    """Normal terms on the known sizes of one group, log t = slope x - precision x^2 / 2."""

    precision: Array  # (num_causes,), 0 for sizes of either sign
    slope: Array  # (num_causes,)

    @classmethod
    def none(cls, local: Local) -> Terms:
        """Terms that say nothing."""
        return cls(np.zeros(len(local.causes)), np.zeros(len(local.causes)))

    def on(self, local: Local) -> Local:
        """A group with the terms among what its samples say."""
        curvature, slope = local.curvature.copy(), local.slope.copy()
        at = np.arange(local.num_nuisances, len(slope))
        curvature[at, at] += self.precision
        slope[at] += self.slope
        return replace(local, curvature=curvature, slope=slope)

    def renewed(self, local: Local, mean: Array, variance: Array, one: Collection[str]) -> Terms:
        """Terms by which sizes have the mean and variance that they have above 0.

        Args:
            mean: Of its sizes with these terms, (num_causes,).
            variance: Of its sizes with these terms, (num_causes,).
            one: Causes whose size is never below 0.
        """
        free = 1.0 / np.maximum(1.0 / variance - self.precision, SMALLEST_SHARE / variance)
        center = free * (mean / variance - self.slope)
        above, left = above_zero(center, free)
        held = np.array([cause in one for cause in local.causes], dtype=bool)
        precision = np.maximum(1.0 / left - 1.0 / free, 0.0)
        return Terms(
            np.where(held, precision, 0.0),
            np.where(held, above * (precision + 1.0 / free) - center / free, 0.0),
        )


def above_zero(mean: Array, variance: Array) -> tuple[Array, Array]:
    """Mean and variance of normal numbers, given that they are above 0.

    Args:
        mean: Means without the condition, (n,).
        variance: Variances without it, (n,).

    Source: Johnson, Kotz, Balakrishnan, Continuous Univariate Distributions 1 (1994), 13.10.1.
    """
    sd = np.sqrt(variance)
    at = mean / sd
    ratio = np.exp(-0.5 * at**2 - 0.5 * np.log(2.0 * np.pi) - log_ndtr(at))
    share = np.maximum(1.0 - ratio * (ratio + at), SMALLEST_SHARE)
    return np.asarray(mean + sd * ratio), np.asarray(variance * share)
