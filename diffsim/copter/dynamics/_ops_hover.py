"""Dimensionless hover thrusts as torch custom ops; see ``csrc/kernels/copter/hover.h``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Op, array

INFO = ("status", "rank", "free_rank", "num_iters")
FEASIBLE: float = core.HOVER_FEASIBLE
"""Residual below which thrusts hover."""
STATUSES = ("optimal", "infeasible", "rank_deficient", "not_converged")


class HoverProblem(NamedTuple):
    """A batch of dimensionless hover problems; also the gradients of these."""

    force: Tensor  # M_f over the number of rotors, (batch, 3, n_rotors) [-]
    torque: Tensor  # M_t over the same and a mean lever, (batch, 3, n_rotors) [-]
    weights: Tensor  # h of the effort, mean 1, (batch, n_rotors) [-]
    upper: Tensor  # largest thrusts in shares of the weight per rotor, (batch, n_rotors) [-]


class HoverSolution(NamedTuple):
    """What the solver returns."""

    thrusts: Tensor  # thrusts in shares of the weight per rotor, (batch, n_rotors) [-]
    multipliers: Tensor  # multipliers of lift and the three torques, (batch, 4); no gradient
    state: Tensor  # -1 at the lower, 1 at the upper bound, else 0, (batch, n_rotors) int64
    info: Tensor  # ``INFO``, (batch, 4) int64


# Adjoint: the KKT system of the free rotors, derived in csrc/kernels/copter/hover_adjoint.cpp.
hover = Op(
    "hover",
    inputs=dict.fromkeys(("force", "torque"), array("batch", 3, "num_rotors"))
    | dict.fromkeys(("weights", "upper"), array("batch", "num_rotors")),
    outputs={
        "thrusts": array("batch", "num_rotors"),
        "multipliers": array("batch", 4, smooth=False),
        "state": array("batch", "num_rotors", dtype=torch.int64, smooth=False),
        "info": array("batch", len(INFO), dtype=torch.int64, smooth=False),
    },
    options="float barrier, int num_threads",
    reads=(*HoverProblem._fields, *HoverSolution._fields),
    kernel=lambda call: core.hover(**call.addresses(), **call.sizes),
    adjoint=lambda call: core.hover_vjp(**call.addresses(), **call.sizes),
    tangent=lambda call: core.hover_tangent(**call.addresses(), **call.sizes),
)


def solve(problem: HoverProblem, *, barrier: float, num_threads: int) -> HoverSolution:
    """Thrusts of least effort; ``barrier`` weighs the logarithms of the distances to the bounds."""
    return HoverSolution(*hover(*problem, barrier, num_threads))
