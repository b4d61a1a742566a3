"""The problem of one implicit step along many directions of what it is made of."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffsim.soft import _ops_step
from diffsim.soft._context import small_strain_lambda
from diffsim.soft.integrators import Stage
from diffsim.soft.physics import Physics
from diffsim.soft.problem import Problem
from diffsim.soft.state import State


def solve_along(problem: Problem, x: Tensor, rates: Mapping[str, Tensor]) -> Tensor:
    """Derivatives of a problem's solution x along K directions.

    Args:
        problem: The problem, without batch axes.
        x: Its solution, (num_nodes, 3) [m].
        rates: Directions by name of ``StepArrays.differentiable()``, with a leading K.

    Returns:
        (K, num_nodes, 3) [m] per unit of each direction.
    """
    return _ops_step.step_tangents(
        x[None].contiguous(),
        problem.arrays(),
        {name: rate.contiguous() for name, rate in rates.items()},
        **problem.loads.prepared.adjoint_arguments,
    )


def stage_rates(
    problem: Problem,
    stage: Stage,
    d_stage: Stage,
    moving: State,
    moved: Mapping[str, Tensor | None],
    changing: Physics,
) -> dict[str, Tensor]:
    """Directions in the inputs of a step's problem, see ``stage_problem``."""
    physics, (c, kappa) = problem.loads.physics, stage.rates
    alpha = physics.rayleigh_alpha * kappa
    total, d_total = c + alpha, changing.rayleigh_alpha * kappa
    rates = {
        "y": (
            c * d_stage.y
            + alpha * d_stage.x_velocity
            + d_total[:, None, None] * (stage.x_velocity - problem.y)
        )
        / total,
        "inertia": d_total[:, None] * physics.mass + total * changing.mass,
    }
    rates |= load_rates(problem, moved, changing)
    if problem.loads.prepared.is_linear:  # its steps are linearized at the old positions
        rates["guess"] = moving.x
    if stage.midpoint:  # its unknown is in the middle of the step
        rates["target"] = 0.5 * (moving.x + rates.get("target", torch.zeros_like(moving.x)))
    if physics.rayleigh_beta is not None:
        beta, d_beta = physics.rayleigh_beta, changing.rayleigh_beta
        d_beta = torch.zeros_like(changing.w_mu) if d_beta is None else d_beta
        for name, w, d_w in (
            ("damp_mu", physics.w_mu, changing.w_mu),
            (
                "damp_lambda",
                small_strain_lambda(physics.material, physics.w_vol),
                small_strain_lambda(physics.material, changing.w_vol),
            ),
        ):
            rates[name] = kappa * (d_beta * w + beta * d_w)
        rates["x_frame"], rates["x_velocity"] = d_stage.y, d_stage.x_velocity
    return rates | stiffness_rates(problem, moved["activation"], changing)


def load_rates(
    problem: Problem, moved: Mapping[str, Tensor | None], changing: Physics
) -> dict[str, Tensor]:
    """Rates of force, chambers and Dirichlet targets; weight is among the forces."""
    physics = problem.loads.physics
    force = (
        changing.weighing_mass[:, :, None] * physics.gravity
        + physics.weighing_mass[:, None] * changing.gravity[:, None, :]
    )
    d_force, d_target = moved["external_force"], moved["dirichlet_target"]
    rates = {"force": force if d_force is None else force + d_force}
    if moved["pressure"] is not None:
        rates["pressure"] = moved["pressure"]
    if d_target is not None:
        rates["target"] = d_target
    return rates


def stiffness_rates(
    problem: Problem, d_activation: Tensor | None, changing: Physics
) -> dict[str, Tensor]:
    """Rates of the solid's weights and of the fibers (``MuscleSet.fibers``)."""
    rates = {"w_mu": changing.w_mu, "w_vol": changing.w_vol}
    muscles = problem.loads.prepared.body.muscles
    if not muscles.num_muscles:
        return rates
    d_stiffness = changing.fiber_stiffness
    if d_activation is None:
        d_activation = torch.zeros_like(d_stiffness)
    if muscles.has_contraction:
        which, slack = muscles.contraction, 1.0 - problem.loads.activation
        stiffness = problem.loads.physics.fiber_stiffness
        contracted = slack**2 * d_stiffness - 2.0 * slack * stiffness * d_activation
        d_stiffness = torch.where(which, contracted, d_stiffness)
        d_activation = torch.where(which, torch.zeros_like(d_activation), d_activation)
    rates["fiber_stiffness"] = d_stiffness[:, muscles.owner] * muscles.weights
    rates["activation"] = d_activation[:, muscles.owner]
    return rates
