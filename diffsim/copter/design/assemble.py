"""From a specification to an assembly: compose, eliminate, start at the closest feasible point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.design.compose import Composer
from diffsim.copter.design.constraints import matrix
from diffsim.copter.design.contact import Target
from diffsim.copter.design.feasible import FeasibleSet, eliminate, staged_least_squares
from diffsim.copter.design.placement import PlacedPart, distance_weights
from diffsim.copter.design.spec import DesignSpec
from diffsim.core.arrays import Array


class Assembly(NamedTuple):
    """Composed parts, their feasible set and a point in it."""

    parts: tuple[PlacedPart, ...]  # all of them, adapters included
    feasible: FeasibleSet  # constraints and their elimination
    values: Tensor  # free parameters s, (n_free,) [m]


def assemble(spec: DesignSpec) -> Assembly:
    """Compose a specification; start at the feasible point closest to what its author gave.

    Raises:
        ValueError: unknown names, parts that face the wrong way or are connected to nothing.
        MeshError: a part that is not closed.
        InfeasibleDesignError: constraints that exclude each other, with an irreducible set.
    """
    if not spec.parts:
        raise ValueError(f"design {spec.name!r} has no parts")
    composer = Composer(spec)
    composer.compose()
    parts = tuple(composer.placed.values())
    names = [n for p in parts for n in (*p.shape_names, *p.position_names)]
    feasible = eliminate(names, composer.constraints, _preference(parts))
    asked: list[Target] = []
    for name, value in spec.values.items():
        asked.append((composer.form(name), float(value)))
    stages = [_stage(names, t, feasible) for t in (asked, composer.explicit, composer.defaults)]
    s = staged_least_squares(stages, len(feasible.free_idx))
    if feasible.violation(s) > 1e-9:
        s = feasible.closest(feasible.offset + feasible.basis @ s, distance_weights(parts))
    return Assembly(parts, feasible, torch.from_numpy(s))


def _stage(
    names: list[str], targets: Sequence[Target], feasible: FeasibleSet
) -> tuple[Array, Array]:
    rows, values = matrix(names, [form.equals(value, "") for form, value in targets])
    return rows @ feasible.basis, values - rows @ feasible.offset


def _preference(parts: Sequence[PlacedPart]) -> Array:
    """Which parameters become free: shapes, then places of motors, rods, others, adapters."""
    levels = []
    for p in parts:
        place = 0.0 if p.automatic else 1.0
        place = 2.0 if p.part.rod_parameter is not None else place
        place = 3.0 if p.part.rotor_mount is not None else place
        levels += [3.5 if p.automatic else 4.0] * len(p.shape_names) + [place] * 3
    return np.array(levels) - 1e-6 * np.arange(len(levels))  # the first of equals
