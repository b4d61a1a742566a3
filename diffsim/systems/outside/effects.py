"""Causes that act on the hooks of an outside simulator: on commands, at places, on channels."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from torch import Tensor

from diffsim.causes.commands import command_causes
from diffsim.causes.readings import reading_causes
from diffsim.causes.row import spell_plainly
from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import UnknownForce, smooth_covariance
from diffsim.systems.outside.forces import ForceKnots
from diffsim.systems.outside.hooks import Hooks
from diffsim.systems.outside.model import OutsideScene
from diffsim.systems.outside.place_effects import place_effects

MAX_KNOTS = 24


def outside_library(hooks: Hooks) -> list[Effect]:
    """Candidate causes that these hooks allow.

    Args:
        hooks: Groups of commands, places of forces, instruments.
    """
    out: list[Effect] = []
    for group in hooks.commands:
        out += command_causes(group, system="outside")
    for place in hooks.places:
        out += place_effects(place)
    for instrument in hooks.instruments:
        out += reading_causes(instrument, system="outside")
    return out


def unknown_forces(hooks: Hooks, runs: Sequence[Run]) -> tuple[UnknownForce, ...]:
    """A smooth force without a form at each place; over the longest run.

    Args:
        hooks: Hooks with the places.
        runs: Runs of the study.
    """
    longest = max(float(run.time_s[-1] - run.time_s[0]) for run in runs)
    count = MAX_KNOTS
    spacing = longest / (count - 1)
    covariance = smooth_covariance(np.linspace(0.0, longest, count), 2.0 * spacing)
    out = []
    for i, place in enumerate(hooks.places):
        effect = Effect(
            name=f"unknown_force_at_{spell_plainly(place.name)}",
            form=f"Force at {place.name}, one component per knot in time.",
            family="unknown",
            kind="force",
            unit=place.unit,
            typical=place.typical,
            also_looks_like=("anything",),
            apply=partial(_apply_knots, place=i, spacing=spacing),
            components=tuple(f"knot_{k}" for k in range(count)),
        )
        out.append(UnknownForce(effect, covariance, f"unknown force at {place.name}"))
    return tuple(out)


def _apply_knots(
    scene: OutsideScene, size: Tensor, run: Run, *, place: int, spacing: float
) -> OutsideScene:
    values = tuple(size.detach().tolist())
    return scene.with_knots(ForceKnots(place, float(run.time_s[0]), spacing, values))
