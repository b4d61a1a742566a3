"""Unknown forces at the places of an outside simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from torch import Tensor

from diffsim.causes.plant import Place
from diffsim.causes.row import spell_plainly
from diffsim.core.checked import checked
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.outside.forces import ForceKnots
from diffsim.systems.outside.model import OutsideScene

MAX_KNOTS = 24


@checked
def unknown_forces(places: Mapping[str, Place], runs: Sequence[Run]) -> tuple[UnknownForce, ...]:
    """A smooth force without a form at each place; over the longest run.

    Args:
        places: Places by name.
        runs: Runs of the study.
    """
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    count = MAX_KNOTS
    spacing = longest / (count - 1)
    covariance = smooth_covariance(np.linspace(0.0, longest, count), 2.0 * spacing)
    out = []
    for name, place in places.items():
        effect = Effect(
            name=f"unknown_force_at_{spell_plainly(name)}",
            form=f"Force at {name}, one component per knot in time.",
            family="unknown",
            kind="force",
            unit=place.unit,
            typical=place.magnitudes["push"],
            also_looks_like=("anything",),
            apply=partial(_apply_knots, place=name, spacing=spacing),
            components=tuple(f"knot_{k}" for k in range(count)),
        )
        out.append(UnknownForce(effect, covariance, f"unknown force at {name}"))
    return tuple(out)


def _apply_knots(
    scene: OutsideScene, size: Tensor, run: Run, *, place: str, spacing: float
) -> OutsideScene:
    values = tuple(size.detach().tolist())
    knots = ForceKnots(place, float(run.time_s[0]), spacing, values)
    return scene.changed(knots=(*scene.knots, knots))
