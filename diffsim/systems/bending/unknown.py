"""A generic smooth moment on a bent body: a cause without a form."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.bending.scene import BendingScene


def _turned(scene: BendingScene, size: Tensor, run: Run, *, spacing: float) -> BendingScene:
    return scene.with_moment(size, spacing)


def unknown_moment(runs: Sequence[Run], knots_per_s: float) -> UnknownForce:
    """Over the longest of the runs; the correlation length is two knots."""
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    count = round(longest * knots_per_s) + 1
    spacing = longest / (count - 1)
    effect = Effect(
        name="unknown_moment",
        form="Moment in the plane of bending, one component per knot in time.",
        family="unknown",
        kind="force",
        unit="rad",
        typical=0.1,
        also_looks_like=("anything",),
        apply=partial(_turned, spacing=spacing),
        components=tuple(f"knot_{k}" for k in range(count)),
    )
    covariance = smooth_covariance(np.linspace(0.0, longest, count), 2.0 * spacing)
    return UnknownForce(effect, covariance, "unknown moment")
