"""Equilibria of slender rods as an op; see ``csrc/kernels/rod/rod.h``."""

from __future__ import annotations

from typing import Any

import torch

from diffsim.core.compiled import core
from diffsim.core.ops import Array, Call, Op, array

Place = tuple[int, int, int]
MOST_STEPS: int = core.ROD_MOST_STEPS
"""Steps of Newton's method after which there is no equilibrium."""

BODY = {
    "edges": array("num_edges", smooth=False),
    "radius": array("num_elements", smooth=False),
    "point_at": array("num_points", smooth=False),
    "around": array("num_points", smooth=False, dtype=torch.int64),
}
"""What all rods of a batch have in common, by the names that the kernel has for it."""


def _field(*axes: str | int) -> Array:
    return array("rows?", "columns?", *axes)


FIELDS = {
    "bending": _field("num_elements", 3),
    "stretch": _field("num_elements", 3),
    "rest": _field("num_elements", 3),
    "stiffening": _field(),
    "weight": _field("num_elements", 3),
    "loads": _field("num_loads", 3),
    "points": _field("num_points", 3),
    "base": _field(3, 3),
    "place": _field(3),
    "offset": _field("num_tendons", "num_elements", 3),
    "slope": _field("num_tendons", "num_elements", 3),
    "share": _field("num_tendons", "num_elements"),
    "pull": _field("num_tendons"),
    "friction": _field(),
    "wobble": _field(),
    "rubber": _field(),
}
"""The numbers of a rod, in the order of the kernel; an axis of a batch is whole or shared."""
SIZES = ("num_elements", "num_tendons", "num_loads", "num_points", "rows", "columns", "num_threads")


def _batch(call: Call) -> Any:
    sizes = {name: call.sizes[name] for name in SIZES}
    return core.RodBatch(**call.addresses(*BODY), **sizes, fields=_fields(call, ""))


def _fields(call: Call, prefix: str) -> list[Place]:
    return [_place(call, prefix + name) for name in FIELDS]


def _place(call: Call, name: str) -> Place:
    """Where a tensor lies, and the lengths of its two leading axes."""
    value = call[name]
    return value.data_ptr(), value.shape[0], value.shape[1]


def _solve(call: Call) -> None:
    options = call.options
    found = call.addresses("strains", "places", "turns").values()
    core.rod_solve(
        _batch(call), options["tolerance"], options["straight"], _place(call, "start"), *found
    )


def _adjoint(call: Call) -> None:
    places = call.addresses("strains", "grad_strains", "grad_places").values()
    core.rod_solve_vjp(_batch(call), *places, _fields(call, "grad_"))


def _tangent(call: Call) -> None:
    places = call.addresses("strains", "d_strains", "d_places").values()
    core.rod_solve_tangent(_batch(call), _fields(call, "d_"), *places)


def _survey(call: Call) -> None:
    core.rod_survey(_batch(call), *call.addresses("strains", *SURVEY).values())


SOLVED = {
    "strains": array("rows", "columns", "num_elements", 3),
    "places": array("rows", "columns", "num_points", 3),
}

rod_solve = Op(
    "rod_solve",
    inputs=BODY | FIELDS | {"start": _field("num_elements", 3)._replace(smooth=False)},
    outputs=SOLVED | {"turns": array("rows", "columns", smooth=False)},
    options="int rows, int columns, float tolerance, bool straight, int num_threads",
    reads=(*BODY, *FIELDS, "strains"),
    kernel=_solve,
    adjoint=_adjoint,
    tangent=_tangent,
)

SURVEY = {
    "frames": array("rows", "columns", "num_edges", 3, 3, smooth=False),
    "nodes": array("rows", "columns", "num_edges", 3, smooth=False),
    "stretches": array("rows", "columns", "num_elements", 3, smooth=False),
    "tensions": array("rows", "columns", "num_elements", "num_tendons", smooth=False),
    "residual": array("rows", "columns", "num_elements", 3, smooth=False),
}
"""What else is known of rods of given strains."""

rod_survey = Op(
    "rod_survey",
    inputs={
        name: spec._replace(smooth=False)
        for name, spec in (BODY | FIELDS | {"strains": SOLVED["strains"]}).items()
    },
    outputs=SURVEY,
    options="int rows, int columns, int num_threads",
    kernel=_survey,
)
