"""Where a cause lies in time, read off the force that the data ask for.

A cause of limited duration has an onset, a width, a period: a descent from zero finds none of
them. Any course in time is made of knots. Their responses are linear, so that the misfit under any
form at any place in time follows from one Gram matrix, without another simulation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from diffsim.core.arrays import Array


@dataclass(frozen=True, eq=False)
class Course:
    """What any course in time would gain, all that is fitted refitted with it.

    Attributes:
        times: Time of each knot in the runs' clock, (K,) [s].
        gram: Whitened responses of the knots times each other, (K, K) [1/unit^2].
        score: Whitened responses of the knots times the residual, (K,) [1/unit].
    """

    times: Array
    gram: Array
    score: Array

    def sizes(self, shapes: Array) -> Array:
        """Best size of each shape, (C,) [unit]; 0 where the data do not move.

        Args:
            shapes: Values at the knots, (K, C).
        """
        power = np.einsum("kc,kc->c", shapes, self.gram @ shapes)
        # what hardly moves the record would be divided by rounding
        seen = power > 1e-6 * float(np.diag(self.gram).max(initial=0.0))  # of the most visible knot
        return np.divide(self.score @ shapes, power, out=np.zeros(len(power)), where=seen)

    def gains(self, shapes: Array) -> Array:
        """What each shape gains at its best size, (C,) [nats]."""
        return np.asarray(0.5 * self.sizes(shapes) * (self.score @ shapes))

    def force(self, usual: float) -> Array:
        """The course that the data ask for, (K,) [unit].

        Args:
            usual: Standard deviation of each knot beforehand [unit].
        """
        k = len(self.times)
        return np.asarray(np.linalg.solve(self.gram + np.eye(k) / usual**2, self.score))


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """A place in time that is worth a simulation."""

    sizes: Array  # sizes of the effect's components, (num_components,) [unit]
    # base parameters by name that go with them, such as onset and width
    parameters: Mapping[str, float] = field(default_factory=dict)
