"""A generic smooth moment on a bent body: a cause without a form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.bending.scene import BendingScene


class _UnknownMoment(Effect):
    """Moment in the plane of bending, one component per knot in time."""

    name, family, kind, unit, typical = "unknown_moment", "unknown", "force", "rad", 0.1
    also_looks_like = ("anything",)

    def __init__(self, spacing: float):
        self._spacing = spacing

    def apply(self, scene: BendingScene, size: Tensor, run: Run) -> BendingScene:
        return scene.with_moment(size, self._spacing)


def unknown_moment(runs: Sequence[Run], knots_per_s: float) -> UnknownForce:
    """Over the longest of the runs; the correlation length is two knots."""
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    count = round(longest * knots_per_s) + 1
    spacing = longest / (count - 1)
    names = tuple(f"knot_{k}" for k in range(count))
    effect = type("UnknownMoment", (_UnknownMoment,), {"components": names})(spacing)
    covariance = smooth_covariance(np.linspace(0.0, longest, count), 2.0 * spacing)
    return UnknownForce(effect, covariance, "unknown moment")
