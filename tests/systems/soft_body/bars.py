"""Described bars, held at one end, as models: let go, pulled by a tendon, or held by a hand."""

from collections.abc import Mapping
from typing import Any

from diffsim.data.study import Run
from diffsim.systems.description import BaseParameters
from diffsim.systems.soft_body import SoftModel
from diffsim.systems.soft_body.described import DescribedModel
from diffsim.systems.soft_body.description import SoftBodyDescription

PLACES = {"tip1": [0, 0.015, 0.036], "tip2": [0, -0.006, 0.024], "tip3": [0, 0.036, 0.006]}
DAMPED = {"value": 2e-3, "percent": 70}


def numerics(dt_s: float, integrator: str, rtol: float) -> dict[str, Any]:
    """Keys of a mesh that is taken as it is."""
    return {
        "time_step": dt_s,
        "integrator": integrator,
        "tolerance": rtol,
        "correct_mesh": False,
    }


def released_bar(
    *,
    cells: tuple[int, int, int] = (6, 2, 2),
    dt_s: float = 4e-3,
    integrator: str = "bdf2",
    rtol: float = 1e-8,
    young: float = 2.6e5,
    gravity: float = 9.81,
    is_damped: bool = True,
) -> dict[str, Any]:
    """A silicone bar with markers on stubs at its tip, straight until it is let go at 0."""
    damping = {"rayleigh_beta": DAMPED} if is_damped else {}
    return {
        "system": "soft_body",
        "body": {"bar": {"size": [0.1, 0.03, 0.03], "corner": [-0.1, 0, 0], "cells": list(cells)}},
        "material": {"youngs_modulus": {"value": young, "percent": 30}, "density": 1070, **damping},
        "fixed": [{"x": -0.1}],
        "gravity": {"vector": [0, 0, -gravity]},
        "sliding": {"x": 0},
        "markers": {name: {"at": at, "carried_by": {"x": 0}} for name, at in PLACES.items()},
        "channels": {axis: {"markers": list(PLACES), "axis": axis} for axis in "xyz"},
        "start": {"shape": "rest", "at": 0},
        "numerics": numerics(dt_s, integrator, rtol),
    }


def pulled_bar(
    *,
    cells: tuple[int, int, int] = (10, 2, 2),
    dt_s: float = 4e-3,
    rtol: float = 1e-8,
    in_water: bool = False,
) -> dict[str, Any]:
    """A bar with a tendon a quarter of its height from the top, in equilibrium at first."""
    water = {"water": {"added_mass": 0.0}} if in_water else {}
    path = [[0, 0.01, 0.015], [0.1, 0.01, 0.015]]
    return {
        "system": "soft_body",
        "body": {"bar": {"size": [0.1, 0.02, 0.02], "cells": list(cells)}},
        "material": {
            "youngs_modulus": {"value": 2.6e5, "percent": 30},
            "density": 1070,
            "rayleigh_beta": DAMPED,
        },
        "fixed": [{"x": 0}],
        "tendons": [
            {
                "name": "tendon",
                "command": "shortening",
                "means": "share",
                "path": path,
                "axial_stiffness": {"value": 40, "percent": 30},
            }
        ],
        **water,
        "markers": {"tip": {"at": [0.1, 0.01, 0.01], "carried_by": {"x": 0.1}}},
        "channels": {axis: {"markers": "tip", "axis": axis} for axis in "xyz"},
        "numerics": numerics(dt_s, "bdf2", rtol),
    }


def held_bar() -> dict[str, Any]:
    """The silicone bar, its tip held by a hand until 0; a weight may hang from it."""
    weight = {"where": {"x": 0, "z": 0.03}, "mass_from": "load_kg"}
    return released_bar(
        cells=(6, 1, 2), integrator="implicit_midpoint", rtol=1e-11
    ) | {
        "masses": [weight],
        "start": {"shape": "held", "where": {"x": 0}, "axes": "z", "at": 0},
    }  # fmt: skip


def model_of(body: Mapping[str, Any], run: Run) -> SoftModel:
    """The model of a described body whose channels are x, y and z of the tip."""
    given = SoftBodyDescription.model_validate(dict(body))
    parameters = BaseParameters(given.quantities(), (run,))
    return DescribedModel(given, None, tuple("xyz"), parameters).model()
