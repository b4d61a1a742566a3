"""A domain proposed for Mosaic: where does a soft beam swing, and what is it made of?

A clamped beam of hexahedra is let go under gravity. Inputs: Young's modulus of every cell and the
initial velocity of every node. Output: the path of the tip's center. Large rotations, a horizon of
many steps, and a gradient that must go back through all of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.mosaic.pull_back import leaves_of, pull_back
from diffsim import mesh, soft

INPUTS = ("youngs_modulus", "velocity")
DIFFERENTIABLE = (set(INPUTS), {"tip_path"})


def inputs(n: int = 8, steps: int = 20) -> dict[str, Any]:
    """Inputs of the domain at resolution ``n``: n x 2 x 2 cells, 0.1 x 0.03 x 0.03 m."""
    cells = (n, 2, 2)
    nodes = (n + 1) * 9
    return {
        "youngs_modulus": np.full(n * 4, 2e5, np.float32),
        "velocity": np.zeros((nodes, 3), np.float32),
        "cells": cells,
        "size": (0.1, 0.03, 0.03),
        "dt": 0.005,
        "steps": steps,
        "poissons_ratio": 0.45,
        "density": 1070.0,
        "gravity": (0.0, 0.0, -9.81),
    }


def apply(given: dict[str, Any]) -> dict[str, np.ndarray]:
    """``tip_path``: mean position of the nodes of the free face, (steps + 1, 3) [m]."""
    with torch.no_grad():
        return {"tip_path": _path(given, **leaves_of(given, INPUTS)).numpy().astype(np.float32)}


def vector_jacobian_product(
    given: dict[str, Any],
    vjp_inputs: set[str],
    vjp_outputs: set[str],
    cotangent_vector: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Cotangent of the path, pulled back through all steps by the adjoint."""
    if not (vjp_inputs <= DIFFERENTIABLE[0] and vjp_outputs <= DIFFERENTIABLE[1]):
        raise ValueError(f"differentiable are {DIFFERENTIABLE}, got {vjp_inputs}, {vjp_outputs}")
    function = partial(_path, given)
    return pull_back(function, leaves_of(given, INPUTS), vjp_inputs, cotangent_vector["tip_path"])


def _path(
    given: dict[str, Any], youngs_modulus: torch.Tensor, velocity: torch.Tensor
) -> torch.Tensor:
    beam = mesh.hex_box(given["cells"], given["size"])
    body = soft.SoftBody(
        beam,
        dt=given["dt"],
        youngs_modulus=youngs_modulus.detach(),
        poissons_ratio=given["poissons_ratio"],
        density=given["density"],
        gravity=given["gravity"],
        material="stable_neo_hookean",
        fixed=beam.nodes_near_plane("x", 0.0),
        integrator="implicit_midpoint",
    )
    start = soft.State(beam.nodes, velocity)
    physics = body.physics(youngs_modulus=youngs_modulus)
    motion = soft.rollout(body, start, given["steps"], physics=physics)
    return motion.x[:, beam.nodes_near_plane("x", given["size"][0])].mean(1)
