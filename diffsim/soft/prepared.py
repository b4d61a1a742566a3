"""A body with its parameters, checked and expanded once for all steps of a rollout."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require_constant
from diffsim.core.layer import is_followed, is_kernel_alone
from diffsim.core.numbers import values_of, without_mapping
from diffsim.core.torch_names import has_modes
from diffsim.soft import _ops_step
from diffsim.soft._arrays import StepArrays
from diffsim.soft._ops_step import LINEAR, BoundStep
from diffsim.soft.integrators import Rates, rates_of
from diffsim.soft.physics import DampingWeights, Physics, require_physics
from diffsim.soft.solid import Solid


@dataclass(frozen=True, kw_only=True, eq=False)
class StageTerms:
    """What no state changes in the problem of a step."""

    alpha: Tensor  # mass-proportional damping per displacement, (..., 1, 1) [1/s^2]
    total: Tensor  # inertia per mass with that damping, (..., 1, 1) [1/s^2]
    inertia: Tensor  # the same of each node, (num_nodes,) [N/m]
    damping: DampingWeights | None  # weights of stiffness-proportional damping; None: none

    @classmethod
    def of(cls, physics: Physics, rates: Rates) -> StageTerms:
        """The terms of an integrator's constants."""
        alpha = physics.rayleigh_alpha * rates.kappa
        damping = physics.damping(rates.kappa)
        nodal = alpha[..., None, None]  # one number, or one per member
        return cls(
            alpha=nodal,
            total=rates.c + nodal,
            inertia=((rates.c + alpha[..., None]) * physics.mass).contiguous(),
            damping=None if damping is None else DampingWeights(*(w.contiguous() for w in damping)),
        )


def _require_own_shape(body: Solid) -> None:
    """Refuse a rest shape that was put in place of the mesh's, or that a gradient is asked of: what
    kernels know of the shape was made from the mesh, once."""
    if not hasattr(body, "x_rest"):
        raise TypeError(f"body must be a SoftBody, got {type(body).__name__}")
    hint = "the shape that has a gradient is that of body.physics(x_rest=...)"
    own, whole = body.x_rest, body.mesh.x_rest
    require_constant("x_rest", without_mapping(own), hint)
    if own is whole or torch.compiler.is_compiling():  # a graph has no values
        return
    numbers = values_of(own)  # of a stack of bodies (torch.func.stack_module_state) all at once
    if numbers.shape[-2:] != whole.shape or not bool((numbers == whole).all()):
        raise ValueError(
            "x_rest of a body must be its mesh's, float64; give another shape to "
            "body.physics(x_rest=...) (functional_call cannot change it)"
        )


class PreparedBody:
    """A body with parameters: what all steps of a rollout share.

    Everything that a gradient may pass through is computed here, before the first step: a step
    that checkpointing takes twice does the same both times.

    Args:
        physics: Its parameters, from ``body.physics(...)``; None: the body's own.

    Attributes:
        body, physics: As given.
        weight: Force of gravity, (num_nodes, 3) [N].
        weights: Parameters of the solid as kernels read them, (num_weights, num_elements) [Pa].
        fiber_stiffness: Of each fiber, (num_fibers,) [Pa]; None: it depends on the activation.
        no_pressure: Zeros, for chambers without pressure, (num_chambers,) [Pa].
        x_rest: Rest positions, (num_nodes, 3) [m].
        tables: What kernels know of them, (num_tables,); empty: those of the mesh.
        is_constant: Whether none of these has a gradient.
    """

    def __init__(self, body: Solid, physics: Physics | None):
        _require_own_shape(body)
        physics = body.physics() if physics is None else physics
        muscles = body.muscles
        require_physics(physics, body.sizes, body.material.law)
        self.body, self.physics = body, physics
        self.weight = physics.weighing_mass[..., None] * physics.gravity.unsqueeze(-2)
        self.weights = physics.weights.contiguous()
        self.fiber_stiffness = None
        if not muscles.has_contraction:
            stiffness = muscles.of_fibers(physics.fiber_stiffness, physics.fiber_weights)
            self.fiber_stiffness = self.of_members(stiffness)
        self.no_pressure = torch.zeros(body.chambers.num_chambers, dtype=torch.float64)
        self.x_rest = body.x_rest if physics.x_rest is None else physics.x_rest
        self.tables = self.no_pressure.new_zeros(0) if physics.tables is None else physics.tables
        self._terms: Mapping[Rates, StageTerms] = {
            rates: StageTerms.of(physics, rates) for rates in rates_of(body.integrator, body.dt)
        }
        self._arguments = {"handle": body.handle, **body.solver.arguments()}
        of_terms = [(t.alpha, t.inertia, *(t.damping or ())) for t in self._terms.values()]
        shared = (self.weight, self.weights, self.x_rest, self.tables, *chain(*of_terms))
        self.is_constant = self.fiber_stiffness is not None and not any(
            t.requires_grad for t in (self.fiber_stiffness, *shared)
        )
        self._bound: list[BoundStep] = []  # none or one, that all copies share

    @property
    def is_linear(self) -> bool:
        """Whether steps are linearly implicit."""
        return self.body.solver.method == LINEAR

    def terms(self, rates: Rates) -> StageTerms:
        """The terms of a stage with these constants."""
        return self._terms[rates]

    def of_members(self, fibers: Tensor) -> Tensor:
        """(num_fibers,), for each member of a batch where parameters are given for each."""
        if self.physics.batch is not None and fibers.ndim == 1:  # no fibers
            fibers = fibers.expand(self.physics.batch, -1)
        return fibers.contiguous()

    def solve(self, arrays: StepArrays, *, iterate: bool = False) -> Tensor:
        """Solution of a step's problem, (batch, num_nodes, 3) [m].

        Args:
            arrays: Arrays of the implicit problem of a step.
            iterate: Whether it is asked for where the body's own steps are linearly implicit.
        """
        tensors = arrays.tensors()
        if iterate and self.is_linear:
            iterating = replace(self.body.solver, method="auto")
            return _ops_step.soft_step(*tensors, **self._arguments | iterating.arguments())[0]
        if not is_kernel_alone(tensors):
            return _ops_step.soft_step(*tensors, **self._arguments)[0]
        return self.bound(arrays)(arrays)[0]

    def bound(self, arrays: StepArrays) -> BoundStep:
        """The kernel with the parameters of a problem, made where the last one had others."""
        for known in self._bound:
            if known.shares(arrays):
                return known
        made = BoundStep(arrays, **self._arguments)
        self._bound[:] = [made]
        return made


class KeptBody(NamedTuple):
    """What was prepared last with a body's own parameters, and what they were."""

    settings: tuple[Any, ...]  # integrator, time step, solver, handle and names of the parameters
    values: tuple[Tensor, ...]  # copies of the parameters
    prepared: PreparedBody  # what was prepared, without its body, which it would keep alive


def prepare(body: Solid, physics: Physics | None) -> PreparedBody:
    """A body with parameters, see :class:`PreparedBody`; with its own ones only where one has
    changed since the last call.

    Numbers may change in place behind every counter (``.data``, NumPy), so they are compared.
    Where a derivative may be asked for, or a mode or compiler follows the calls, all is computed
    anew.
    """
    if physics is not None or torch.compiler.is_compiling() or torch.is_inference_mode_enabled():
        return PreparedBody(body, physics)
    own = body.own_values()
    values = tuple(own.values())
    if is_followed(values) or has_modes():
        return PreparedBody(body, None)
    settings = (body.integrator, body.dt, body.solver, body.handle, *own)
    kept = body.kept
    if kept is None or kept.settings != settings or not all(map(torch.equal, kept.values, values)):
        made = PreparedBody(body, None)
        alone = copy(made)
        del alone.body
        body.kept = KeptBody(settings, tuple(v.detach().clone() for v in values), alone)
        return made
    _require_own_shape(body)
    prepared = copy(kept.prepared)
    prepared.body = body
    return prepared
