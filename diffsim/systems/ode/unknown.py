"""Generic causes: a smooth force at each place, or a smooth change of each input."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.identify.effect import Effect
from diffsim.identify.unknown import Unknown, UnknownForce, smooth_covariance
from diffsim.systems.ode.applying import entering
from diffsim.systems.ode.library import SHARE_OF_USUAL, Library
from diffsim.systems.ode.network import Change, named
from diffsim.systems.ode.scene import OdeScene

KNOTS, LEAST_KNOTS = 40, 4  # over the longest run, before anything is fitted
MOST_OF_INPUTS = 2000  # knots of all inputs in all runs: 12,800 took 5 s for each set of causes
MOST_KNOTS = 200  # each costs about a simulation of every command; 4 Hz over 6 s asks for 193


def unknown_forces(library: Library) -> tuple[Unknown, ...]:
    """One for each place; for each input where there is no place; else for each state's rate."""
    system, out = library.system, list[Unknown]()
    for place, scale in library.places:
        name = f"unknown_force_at_{place.name}"
        said = "unknown force" if len(library.places) == 1 else f"unknown force at {place.name}"
        change = _change(library, name, "force", place.name)
        size, knots = SHARE_OF_USUAL * scale.force, place.unknown_knots_per_s
        out.append(_make_smooth(library, name, said, change, place.unit, size, knots))
    for store, usual in library.stores:
        name, said = f"unknown_flow_of_{store.name}", f"unknown flow of {store.name}"
        change = _change(library, name, "rate", store.level)
        unit = "1/s" if store.unit == "-" else f"{store.unit}/s"
        out.append(_make_smooth(library, name, said, change, unit, SHARE_OF_USUAL * usual.rate))
    if out:
        return tuple(out)
    groups = len({run.group for run in library.study.runs})
    most = MOST_OF_INPUTS // max(groups * len(system.held), 1)
    for of in system.held:
        name, said = f"unknown_change_of_{of}", f"unknown change of {of}"
        change = _change(library, name, "input", of)
        size = 0.05 * library.scales.of_commands((of,))["reach"]
        out.append(_make_smooth(library, name, said, change, "command", size, most_knots=most))
    return tuple(out)


def _change(library: Library, name: str, kind: str, target: str) -> Change:
    """What a further input of a name does where it enters."""
    return replace(entering(library.system, kind, target, named(name)), inputs={name: False})


def _make_smooth(
    library: Library,
    name: str,
    said: str,
    change: Change,
    unit: str,
    typical: float,
    knots_per_s: float | None = None,
    most_knots: int = MOST_KNOTS,
) -> UnknownForce:
    longest = library.scales.longest_s
    if knots_per_s is not None:
        count = min(max(round(longest * knots_per_s) + 1, LEAST_KNOTS), MOST_KNOTS)
        return _make_of(longest, name, said, change, unit, typical, count)
    make = partial(_make_of, longest, name, said, change, unit, typical)
    samples = max(len(run.time_s) for run in library.study.runs)
    most = max(min(most_knots, MOST_KNOTS, samples // 2), LEAST_KNOTS)
    return make(min(KNOTS, most), most)


def _make_of(
    longest: float,
    name: str,
    said: str,
    change: Change,
    unit: str,
    typical: float,
    count: int,
    most: int = 0,
) -> UnknownForce:
    """The force with a number of knots; with as many as are asked for later, up to ``most``."""
    spacing = longest / (count - 1)
    effect = Effect(
        name=name,
        form="Any smooth course, one component per knot in time.",
        family="unknown",
        kind="force",
        unit=unit,
        typical=typical,
        also_looks_like=("anything",),
        components=tuple(f"knot_{k}" for k in range(count)),
        apply=partial(apply_knots, name=name, change=change, spacing=spacing),
    )
    knots = np.linspace(0.0, longest, count)
    make = partial(_make_of, longest, name, said, change, unit, typical, most=most)
    smooth = smooth_covariance(knots, 2.0 * spacing)
    return UnknownForce(effect, smooth, said, make if most else None, most)


def apply_knots(
    scene: OdeScene, size: Tensor, run: Run, *, name: str, change: Change, spacing: float
) -> OdeScene:
    place = (scene.grid.times - scene.grid.times[0]) / spacing
    left = place.floor().long().clamp(max=size.shape[-1] - 2)
    share = (place - left).clamp(max=1.0)
    weights = torch.zeros(size.shape[-1], len(place), dtype=torch.float64)
    columns = torch.arange(len(place))
    weights[left, columns] = 1.0 - share
    weights[left + 1, columns] += share
    return scene.with_further_inputs({name: size @ weights}, change)
