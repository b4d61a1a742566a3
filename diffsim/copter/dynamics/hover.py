"""Hover thrusts and attitude of a multicopter as a differentiable layer (thesis 3.3.3, 3.4.2)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.dynamics import _ops_hover
from diffsim.copter.dynamics._ops_hover import HoverProblem, HoverSolution
from diffsim.copter.dynamics.hover_result import HoverResult, report
from diffsim.copter.vehicle.multicopter import Multicopter
from diffsim.core.check import (
    require,
    require_choice,
    require_number,
    require_range,
    require_threads,
)
from diffsim.core.checked import checked
from diffsim.core.module import Float64Module
from diffsim.core.record import announce, is_recording
from diffsim.core.rotation import roll_pitch_of_thrust
from diffsim.core.values import scalar

_WEAK = 1e-6  # multiplier or distance to a bound, in shares of the weight per rotor


def hover_thrusts(
    force_matrix: Tensor,
    torque_matrix: Tensor,
    weight: Tensor,
    max_thrusts: Tensor,
    *,
    weights: Tensor | None = None,
    smoothing: float = 0.0,
    num_threads: int = 1,
) -> HoverResult:
    """Least effort that hovers, for a batch of designs given by their effect matrices.

    min 1/2 sum h_i u_i^2  s.t.  W e_z + R(roll, pitch) M_f u = 0,  M_t u = 0,  0 <= u <= u_max.

    Some attitude puts the net thrust upright if and only if |M_f u| = W, which is how it is solved:
    from level, turning towards the net thrust of the present optimum (the effort never rises), then
    Newton on the optimality conditions. With tilted rotors this is the local optimum reached from
    level. Torque matrices may be relaxed (spins between -1 and 1).

    Args:
        force_matrix: M_f, (..., 3, n_rotors) float64 [-].
        torque_matrix: M_t, (..., 3, n_rotors) float64 [m].
        weight: W, (...) float64 [N], > 0.
        max_thrusts: u_max, (..., n_rotors) float64 [N], >= 0.
        weights: h, (..., n_rotors) float64, > 0, only their ratios matter; None: all equal.
        smoothing: Weight of -log(u) - log(u_max - u), in squared shares of the weight per rotor;
            0: hard limits. Above 0 the thrusts keep off the limits and are smooth in the design.
        num_threads: Threads over the batch; the result does not depend on it.

    Returns:
        Thrusts, attitude and status. Where no thrusts hover, those of least violation
        (1e-6 of effort mixed in to make them unique).

    Raises:
        TypeError, ValueError: wrong types or shapes, values out of range.

    Gradients: force_matrix, torque_matrix, weight, max_thrusts, weights; first order; one-sided
        where ``weakly_active``, least-norm where ``free_rank`` is below 4.
    """
    force_matrix = require("force_matrix", force_matrix, ("...", 3, "n_rotors"))
    n = force_matrix.shape[-1]
    torque_matrix = require("torque_matrix", torque_matrix, ("...", 3, n))
    weight = require("weight", weight, ("...",))
    max_thrusts = require("max_thrusts", max_thrusts, ("...", n))
    weights = torch.ones_like(max_thrusts) if weights is None else weights
    weights = require("weights", weights, ("...", n))
    num_threads = require_threads(num_threads)
    smoothing = require_number("smoothing", smoothing, at_least=0.0)
    if n == 0:
        raise ValueError("force_matrix must have at least one rotor, got none")
    if not torch.compiler.is_compiling():
        require_range("weight", weight, above=0.0)
        require_range("weights", weights, above=0.0)
        hint = "smoothing keeps thrusts between 0 and max_thrusts" if smoothing else ""
        least = {"above": 0.0} if smoothing else {"at_least": 0.0}
        require_range("max_thrusts", max_thrusts, **least, hint=hint)
    batch = np.broadcast_shapes(
        force_matrix.shape[:-2],
        torque_matrix.shape[:-2],
        weight.shape,
        max_thrusts.shape[:-1],
        weights.shape[:-1],
    )
    F = force_matrix.expand(*batch, 3, n).reshape(-1, 3, n)
    T = torque_matrix.expand(*batch, 3, n).reshape(-1, 3, n)
    share = weight.expand(batch).reshape(-1, 1) / n  # [N]
    upper = max_thrusts.expand(*batch, n).reshape(-1, n) / share
    h = weights.expand(*batch, n).reshape(-1, n)
    h = h / h.mean(-1, keepdim=True)
    lever = torch.linalg.vector_norm(T, dim=(-2, -1)) / n**0.5
    lever = torch.where(lever > 0.0, lever, 1.0)[:, None, None]
    problem = HoverProblem(force=F / n, torque=T / (n * lever), weights=h, upper=upper)
    solution = _ops_hover.solve(problem, barrier=smoothing, num_threads=num_threads)
    u, state = solution.thrusts, solution.state
    net = (problem.force @ u[..., None]).squeeze(-1)
    lift = torch.linalg.vector_norm(net, dim=-1, keepdim=True)
    residual = torch.cat([lift - 1.0, (problem.torque @ u[..., None]).squeeze(-1)], -1)
    weak = _weakly_active(problem, solution, net)
    if smoothing:
        weak = torch.zeros_like(weak)
    code, rank, free_rank, num_iters = (solution.info[:, k].reshape(batch) for k in range(4))
    result = HoverResult(
        thrusts=(u * share).reshape(*batch, n),
        attitude=roll_pitch_of_thrust(net).reshape(*batch, 2),
        residual=residual.reshape(*batch, 4),
        multipliers=solution.multipliers.reshape(*batch, 4),
        status_code=code,
        rank=rank,
        free_rank=free_rank,
        active_lower=(state < 0).reshape(*batch, n),
        active_upper=(state > 0).reshape(*batch, n),
        weakly_active=weak.reshape(*batch, n),
        num_iters=num_iters,
    )
    if not torch.compiler.is_compiling() and is_recording():
        announce(result.solve)
    return result


@checked
def hover(
    copter: Multicopter,
    *,
    weights: Tensor | None = None,
    smoothing: float = 0.0,
    load: float | Tensor = 0.0,
    on_infeasible: str = "return",
) -> HoverResult:
    """Thrusts of least effort that hold a multicopter in place, and its attitude.

    See ``hover_thrusts`` for the problem and for ``weights`` and ``smoothing``.

    Args:
        copter: The design; its tensors may carry gradients.
        weights: h, (n_rotors,) float64, > 0.
        smoothing: Log-barrier weight [-]; 0: hard limits.
        load: Weight carried at the center of mass, number or () tensor [N].
        on_infeasible: "return" the least violation, or "raise".

    Returns:
        Thrusts, attitude and status; warns (HoverWarning) where the hover is rank deficient or the
        solve did not converge.

    Raises:
        TypeError, ValueError: as ``hover_thrusts``.
        HoverError: with on_infeasible="raise", where the design does not hover; carries ``result``.

    Gradients: mass, load, positions, directions, torque_ratios, max_thrusts, weights. The inertia
        plays no part; spins are signs: relax them through ``hover_thrusts``.
    """
    require_choice("on_infeasible", on_infeasible, ["return", "raise"])
    result = hover_thrusts(
        copter.force_matrix,
        copter.torque_matrix,
        copter.weight + scalar("load", load),
        copter.max_thrusts,
        weights=weights,
        smoothing=smoothing,
    )
    if not torch.compiler.is_compiling():
        report(result, on_infeasible)
    return result


class Hover(Float64Module):
    """``hover`` with its options, for designs that change.

    Args:
        weights, smoothing, on_infeasible: See ``hover``.
    """

    def __init__(
        self,
        *,
        weights: Tensor | None = None,
        smoothing: float = 0.0,
        on_infeasible: str = "return",
    ):
        super().__init__()
        self.weights: Tensor | None
        self.register_buffer("weights", weights)
        self.smoothing = require_number("smoothing", smoothing, at_least=0.0)
        self.on_infeasible = require_choice("on_infeasible", on_infeasible, ["return", "raise"])

    def forward(self, copter: Multicopter, load: float | Tensor = 0.0) -> HoverResult:
        """Hover of one design with a load [N]."""
        return hover(
            copter,
            weights=self.weights,
            smoothing=self.smoothing,
            load=load,
            on_infeasible=self.on_infeasible,
        )


@torch.no_grad()
def _weakly_active(problem: HoverProblem, solution: HoverSolution, net: Tensor) -> Tensor:
    """A bound that holds without force, or a free thrust next to its bound."""
    u, multipliers, state = solution.thrusts, solution.multipliers, solution.state
    up = net / torch.linalg.vector_norm(net, dim=-1, keepdim=True).clamp_min(1e-300)
    C = torch.cat([up[:, None, :] @ problem.force, problem.torque], dim=-2)
    push = problem.weights * u + (multipliers[:, None, :] @ C).squeeze(-2)
    scale = 1.0 + torch.linalg.vector_norm(multipliers, dim=-1, keepdim=True)
    room = torch.minimum(u, problem.upper - u)
    held = (state != 0) & (problem.upper > 0.0)
    return torch.where(held, push.abs() < _WEAK * scale, (state == 0) & (room < _WEAK))
