"""A domain proposed for Mosaic: how does slow flow leave a channel of any shape?

The shape is a level set at the nodes of a grid, positive in the fluid; walls lie between the nodes.
Output: velocity at the nodes of the open face. The gradient is that of the shape itself, not of a
porosity that stands for it: walls that cut cells anywhere are the difficulty.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from benchmarks.mosaic.pull_back import leaves_of, pull_back
from diffsim.stokes import Grid, Inlet, Open, StokesFlow

INPUTS = ("level_set", "viscosity")
DIFFERENTIABLE = (set(INPUTS), {"outflow"})
HEIGHT = 1.0  # [m]; the channel is 4/3 as long


def inputs(n: int = 24, wall: str = "no_slip") -> dict[str, Any]:
    """Inputs of the domain at resolution ``n``: a channel that narrows, (4 n / 3 + 1, n + 1)."""
    cells = (4 * n // 3, n)
    x, y = np.meshgrid(*(np.arange(c + 1) / n for c in cells), indexing="ij")
    half = 0.37 - 0.12 * (1.0 + np.tanh(6.0 * (x - 0.7))) / 2.0
    return {
        "level_set": (half - np.abs(y - 0.52)).astype(np.float32),
        "viscosity": np.float32(1.0),
        "spacing": HEIGHT / n,
        "inlet_velocity": (1.0, 0.0),
        "wall": wall,
    }


def apply(given: dict[str, Any]) -> dict[str, np.ndarray]:
    """``outflow``: velocity at the nodes of the face x = max, (n + 1, 2) [m/s]; 0 in the solid."""
    with torch.no_grad():
        return {"outflow": _outflow(given, **leaves_of(given, INPUTS)).numpy().astype(np.float32)}


def vector_jacobian_product(
    given: dict[str, Any],
    vjp_inputs: set[str],
    vjp_outputs: set[str],
    cotangent_vector: dict[str, np.ndarray],
) -> dict[str, np.ndarray]:
    """Cotangent of the outflow, pulled back through the flow and its cut cells."""
    if not (vjp_inputs <= DIFFERENTIABLE[0] and vjp_outputs <= DIFFERENTIABLE[1]):
        raise ValueError(f"differentiable are {DIFFERENTIABLE}, got {vjp_inputs}, {vjp_outputs}")
    function = partial(_outflow, given)
    return pull_back(function, leaves_of(given, INPUTS), vjp_inputs, cotangent_vector["outflow"])


def _outflow(
    given: dict[str, Any], level_set: torch.Tensor, viscosity: torch.Tensor
) -> torch.Tensor:
    grid = Grid(tuple(s - 1 for s in level_set.shape), spacing=given["spacing"])
    flow = StokesFlow(grid, [Inlet("x-"), Open("x+")], wall=given["wall"])
    inlet = torch.tensor(given["inlet_velocity"], dtype=torch.float64)
    return flow(level_set, inlet=inlet, viscosity=viscosity).velocity[0, -1]
