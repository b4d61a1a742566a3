"""A free step of implicit Euler as one node of PyTorch's graph.

Beside its kernel a step is a dozen small operations on nodal arrays. Each is a node that PyTorch
makes, keeps and calls; of one small body they take longer than both kernels. Where no derivative by
a parameter of the body can be asked for, they are one node with this adjoint: of

    solution = argmin(y, frame, loads),  y = (c (x + h v) + alpha x) / (c + alpha),
    frame: positions x + h v, velocities from x,  velocity = kappa (solution - x)

with g = dL/dsolution = grad_x + kappa grad_v, and the gradients of argmin for g by name,

    dL/dx = g_y + g_x_frame + g_x_velocity + g_guess - kappa grad_v,
    dL/dv = h (c / (c + alpha) g_y + g_x_frame).

Water around the body, whose force f(x, v) is among the loads, adds (df/dx)' g_force to the one and
(df/dv)' g_force to the other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.core.layer import (
    also_item_by_item,
    first_order,
    is_kernel_alone,
    is_recorded_plainly,
)
from diffsim.soft._arrays import StepArrays
from diffsim.soft._ops_step import BoundStep
from diffsim.soft.hydrodynamics import SteadyWater
from diffsim.soft.inputs import Loads, flat
from diffsim.soft.integrators import Rates, finish_stage, make_stage
from diffsim.soft.problem import stage_problem
from diffsim.soft.state import State


def whole_step(state: State, loads: Loads, water: SteadyWater | None = None) -> State | None:
    """The state after a step, if its derivatives are recorded by nothing but its state and loads.

    Args:
        state: Where it begins, checked.
        loads: What acts in it.
        water: Around the body, whose force is not among the loads; with it also where no
            derivative is asked for.

    Returns:
        The state, of one node; None: its parts have to be taken one by one.
    """
    prepared = loads.prepared
    if not prepared.is_constant or prepared.body.integrator != "implicit_euler":
        return None
    moving = (state.x, state.v, loads.force, loads.activation, loads.pressure, loads.target)
    if is_recorded_plainly((*moving, *(water.tensors() if water else ()))):
        return State(*_Step.apply(loads, water, *moving))
    if water is not None and is_kernel_alone((*moving, *water.tensors())):
        return _Parts.of(state, loads, water, keep=False).end
    return None


class _Parts(NamedTuple):
    """A step without its derivatives."""

    end: State  # the state after it
    bound: BoundStep  # the kernel with the parameters of its problem
    arrays: StepArrays  # of the problem
    rates: Rates  # of its stage

    @classmethod
    def of(cls, state: State, loads: Loads, water: SteadyWater | None, *, keep: bool) -> _Parts:
        """A step under loads, and under the force of water where there is some; keep: for its
        adjoint."""
        prepared, x = loads.prepared, state.x
        body = prepared.body
        if water is not None:
            force = loads.force + water.force(x, state.v)
            loads = loads.with_force(require("external_force", force, tuple(x.shape)))
        stage = make_stage(body.integrator, body.dt, state)
        arrays = stage_problem(stage, x, loads).arrays()
        bound = prepared.bound(arrays)
        solution = bound(arrays, keep=keep)[0].reshape(x.shape)
        end = finish_stage(body.integrator, stage, state, solution, body.fixed)
        return cls(end, bound, arrays, stage.rates)


class _Step(torch.autograd.Function):
    """x, v (..., num_nodes, 3) after a step; see the module for its adjoint."""

    @staticmethod
    def forward(
        ctx: Any,
        loads: Loads,
        water: SteadyWater | None,
        x: Tensor,
        v: Tensor,
        force: Tensor,
        activation: Tensor,
        pressure: Tensor,
        target: Tensor,
    ) -> tuple[Tensor, Tensor]:
        prepared = loads.prepared
        given = Loads(
            force=force, target=target, activation=activation, pressure=pressure, prepared=prepared
        )
        end, bound, arrays, rates = _Parts.of(State(x, v), given, water, keep=True)
        moving = {n: t for n, t in arrays.named().items() if StepArrays.is_batched(n)}
        ctx.bound, ctx.prepared, ctx.rates, ctx.names = bound, prepared, rates, list(moving)
        ctx.water = None if water is None else water.bound
        wet = () if water is None else (x, v, *water.tensors())
        ctx.save_for_backward(end.x, *moving.values(), *wet)
        return end.x, end.v

    @staticmethod
    def backward(ctx: Any, grad_x: Tensor, grad_v: Tensor) -> Any:
        saved = ctx.saved_tensors  # asked for once: checkpoints refuse a second time
        with torch.no_grad():
            found = also_item_by_item(lambda *grads: _pull(ctx, saved, *grads), (grad_x, grad_v))
        return (None, None, *first_order("diffsim.soft_step", saved[0], found))


def _pull(
    ctx: Any, saved: tuple[Tensor, ...], grad_x: Tensor, grad_v: Tensor
) -> tuple[Tensor, ...]:
    """Gradients of x, v, force, activation, pressure and target."""
    solution, *tensors = saved
    prepared, bound, rates = ctx.prepared, ctx.bound, ctx.rates
    terms, muscles = prepared.terms(rates), prepared.body.muscles
    given, wet = dict(zip(ctx.names, tensors, strict=False)), tensors[len(ctx.names) :]
    lead, nodal = solution.shape[:-2], solution.shape
    pulled = rates.kappa * grad_v
    found = bound.adjoint(given, flat(solution), flat(grad_x + pulled))
    along = found["y"].reshape(nodal)
    by_v = along * (rates.c / terms.total)
    by_x = along - pulled
    if "x_frame" in found:
        by_v = by_v + found["x_frame"].reshape(nodal)
        by_x = by_x + (found["x_frame"] + found["x_velocity"]).reshape(nodal)
    if "guess" in found:
        by_x = by_x + found["guess"].reshape(nodal)
    by_force = found["force"].reshape(nodal)
    by_v = by_v * prepared.body.dt
    if wet:
        x, v, *around = wet
        wet_x, wet_v = SteadyWater(ctx.water, *around).adjoint(x, v, by_force)
        by_x, by_v = by_x + wet_x, by_v + wet_v
    of_muscles = found["activation"]
    if muscles.num_muscles:
        none = of_muscles.new_zeros(len(of_muscles), muscles.num_muscles)
        of_muscles = none.index_add_(1, muscles.owner, of_muscles)
    return (
        by_x,
        by_v,
        by_force,
        of_muscles.reshape(*lead, -1),
        found["pressure"].reshape(*lead, -1),
        found["target"].reshape(nodal),
    )
