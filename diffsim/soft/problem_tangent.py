"""The problem of one implicit step along many directions of what it is made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.soft._arrays import StepArrays
from diffsim.soft.integrators import ImplicitStage, Rates, rates_of
from diffsim.soft.materials import small_strain_moduli
from diffsim.soft.physics import Physics
from diffsim.soft.prepared import PreparedBody
from diffsim.soft.problem import StepProblem
from diffsim.soft.state import State


@dataclass(frozen=True, kw_only=True, eq=False)
class ChangingTerms:
    """Directions of :class:`~diffsim.soft.prepared.StageTerms`."""

    total: Tensor  # of the inertia per mass, (K, 1, 1) [1/s^2]
    rates: Mapping[str, Tensor]  # of inertia and weights of damping, by name, as kernels take them

    @classmethod
    def of(cls, physics: Physics, changing: Physics, stage: Rates) -> ChangingTerms:
        """The terms of an integrator's constants."""
        total = stage.c + physics.rayleigh_alpha * stage.kappa
        d_total = changing.rayleigh_alpha * stage.kappa
        rates = {"inertia": d_total[:, None] * physics.mass + total * changing.mass}
        if physics.rayleigh_beta is not None:
            beta, d_beta = physics.rayleigh_beta, changing.rayleigh_beta
            moduli = small_strain_moduli(physics.material, physics.weights)
            d_moduli = small_strain_moduli(physics.material, changing.weights)
            d_beta = torch.zeros_like(d_moduli.two_mu) if d_beta is None else d_beta
            for name, w, d_w in zip(("damp_mu", "damp_lambda"), moduli, d_moduli, strict=True):
                rates[name] = stage.kappa * (d_beta * w + beta * d_w)
        return cls(total=d_total[:, None, None], rates=_contiguous(rates))


class Changing:
    """K directions of a body's parameters: what all steps of a rollout share.

    Args:
        physics: Their directions, with a leading K.

    Attributes:
        prepared, physics: As given.
        weight: Directions of the weight, (K, num_nodes, 3) [N].
        rates: Of the solid's weights, of the rest shape's tables, and of fibers that no activation
            moves, by name, as kernels take them.
    """

    def __init__(self, prepared: PreparedBody, physics: Physics):
        own = prepared.physics
        self.prepared, self.physics = prepared, physics
        self.weight = (
            physics.weighing_mass[:, :, None] * own.gravity
            + own.weighing_mass[:, None] * physics.gravity[:, None, :]
        ).contiguous()
        rates = {"weights": physics.weights}
        if physics.tables is not None:
            rates["tables"] = physics.tables
        muscles = prepared.body.muscles
        if muscles.num_muscles and not muscles.has_contraction:
            d_stiffness = physics.fiber_stiffness
            rates["fiber_stiffness"] = self.of_fibers(own.fiber_stiffness, d_stiffness)
        self.rates = _contiguous(rates)
        body = prepared.body
        self._terms = {
            rates: ChangingTerms.of(own, physics, rates)
            for rates in rates_of(body.integrator, body.dt)
        }

    def terms(self, rates: Rates) -> ChangingTerms:
        """The terms of a stage with these constants."""
        return self._terms[rates]

    def of_fibers(self, stiffness: Tensor, d_stiffness: Tensor) -> Tensor:
        """Directions of the fibers' stiffness, (K, num_fibers), from that of the muscles,
        (num_muscles,), and its directions, (K, num_muscles)."""
        muscles, d_weights = self.prepared.body.muscles, self.physics.fiber_weights
        moved = muscles.of_fibers(d_stiffness, self.prepared.physics.fiber_weights)
        return moved if d_weights is None else moved + muscles.of_fibers(stiffness, d_weights)


def solve_along(
    prepared: PreparedBody, arrays: StepArrays, x: Tensor, rates: Mapping[str, Tensor]
) -> Tensor:
    """Derivatives of a problem's solution x along K directions.

    Args:
        arrays: The problem, of one body.
        x: Its solution, (num_nodes, 3) [m].
        rates: Directions by name of ``StepArrays.specs``, with a leading K.

    Returns:
        (K, num_nodes, 3) [m] per unit of each direction.
    """
    return prepared.bound(arrays).tangents(arrays, x[None].contiguous(), _contiguous(rates))


def stage_rates(
    problem: StepProblem,
    stage: ImplicitStage,
    d_stage: ImplicitStage,
    moving: State,
    moved: Mapping[str, Tensor | None],
    changing: Changing,
) -> dict[str, Tensor]:
    """Directions in the inputs of a step's problem, see ``stage_problem``."""
    prepared, terms = changing.prepared, changing.prepared.terms(stage.rates)
    d_terms = changing.terms(stage.rates)
    rates = {
        "y": (
            stage.rates.c * d_stage.y
            + terms.alpha * d_stage.x_velocity
            + d_terms.total * (stage.x_velocity - problem.y)
        )
        / terms.total,
        **d_terms.rates,
        **load_rates(problem, moved, changing),
    }
    if prepared.is_linear:  # its steps are linearized at the old positions
        rates["guess"] = moving.x
    if stage.midpoint:  # its unknown is in the middle of the step
        target = rates.get("target")
        rates["target"] = 0.5 * (moving.x if target is None else moving.x + target)
    if terms.damping is not None:
        rates["x_frame"], rates["x_velocity"] = d_stage.y, d_stage.x_velocity
    return rates


def load_rates(
    problem: StepProblem, moved: Mapping[str, Tensor | None], changing: Changing
) -> dict[str, Tensor]:
    """Rates of loads and stiffness; weight is among the forces."""
    d_force, d_target = moved["external_force"], moved["dirichlet_target"]
    rates = {"force": changing.weight if d_force is None else changing.weight + d_force}
    if moved["pressure"] is not None:
        rates["pressure"] = moved["pressure"]
    if d_target is not None:
        rates["target"] = d_target
    return rates | changing.rates | _fiber_rates(problem, moved["activation"], changing)


def _fiber_rates(
    problem: StepProblem, d_activation: Tensor | None, changing: Changing
) -> dict[str, Tensor]:
    """Rates of the fibers (``MuscleSet.fibers``) that activations have a part in."""
    muscles = changing.prepared.body.muscles
    if not muscles.has_contraction:
        if d_activation is None or not muscles.num_muscles:
            return {}
        return {"activation": muscles.stretch_of_fibers(d_activation)}
    d_stiffness, which = changing.physics.fiber_stiffness, muscles.contraction
    if d_activation is None:
        d_activation = torch.zeros_like(d_stiffness)
    slack = 1.0 - problem.loads.activation
    stiffness = problem.loads.physics.fiber_stiffness
    contracted = slack**2 * d_stiffness - 2.0 * slack * stiffness * d_activation
    d_stiffness = torch.where(which, contracted, d_stiffness)
    stiffness = torch.where(which, slack**2 * stiffness, stiffness)
    return {
        "fiber_stiffness": changing.of_fibers(stiffness, d_stiffness),
        "activation": muscles.stretch_of_fibers(d_activation.masked_fill(which, 0.0)),
    }


def _contiguous(rates: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: rate.contiguous() for name, rate in rates.items()}
