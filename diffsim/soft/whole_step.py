"""A free step of implicit Euler as one node of PyTorch's graph.

Beside its kernel a step is a dozen small operations on nodal arrays. Each is a node that PyTorch
makes, keeps and calls; of one small body they take longer than both kernels. Where no derivative by
a parameter of the body can be asked for, they are one node with this adjoint: of

    solution = argmin(y, frame, loads),  y = (c (x + h v) + alpha x) / (c + alpha),
    frame: positions x + h v, velocities from x,  velocity = kappa (solution - x)

with g = dL/dsolution = grad_x + kappa grad_v, and the gradients of argmin for g by name,

    dL/dx = g_y + g_x_frame + g_x_velocity + g_guess - kappa grad_v,
    dL/dv = h (c / (c + alpha) g_y + g_x_frame).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffsim.core.layer import also_item_by_item, first_order, is_recorded_plainly
from diffsim.soft._arrays import StepArrays
from diffsim.soft.inputs import Loads, flat
from diffsim.soft.integrators import finish_stage, make_stage
from diffsim.soft.problem import stage_problem
from diffsim.soft.state import State


def is_one_node(state: State, loads: Loads) -> bool:
    """Whether a step's derivatives are recorded, and by nothing but its state and loads."""
    prepared = loads.prepared
    moving = (state.x, state.v, loads.force, loads.activation, loads.pressure, loads.target)
    return (
        prepared.is_constant
        and prepared.body.integrator == "implicit_euler"
        and is_recorded_plainly(moving)
    )


def step_as_node(state: State, loads: Loads) -> State:
    """The state after a step for which :func:`is_one_node` holds."""
    x, v = _Step.apply(
        loads, state.x, state.v, loads.force, loads.activation, loads.pressure, loads.target
    )
    return State(x, v)


class _Step(torch.autograd.Function):
    """x, v (..., num_nodes, 3) after a step; see the module for its adjoint."""

    @staticmethod
    def forward(
        ctx: Any,
        loads: Loads,
        x: Tensor,
        v: Tensor,
        force: Tensor,
        activation: Tensor,
        pressure: Tensor,
        target: Tensor,
    ) -> tuple[Tensor, Tensor]:
        prepared, state = loads.prepared, State(x, v)
        body = prepared.body
        given = Loads(
            force=force, target=target, activation=activation, pressure=pressure, prepared=prepared
        )
        stage = make_stage(body.integrator, body.dt, state)
        arrays = stage_problem(stage, x, given).arrays()
        bound = prepared.bound(arrays)
        solution = bound(arrays, keep=True)[0].reshape(x.shape)
        end = finish_stage(body.integrator, stage, state, solution, body.fixed)
        moving = {n: t for n, t in arrays.named().items() if StepArrays.is_batched(n)}
        ctx.bound, ctx.prepared, ctx.rates, ctx.names = bound, prepared, stage.rates, list(moving)
        ctx.save_for_backward(end.x, *moving.values())
        return end.x, end.v

    @staticmethod
    def backward(ctx: Any, grad_x: Tensor, grad_v: Tensor) -> Any:
        saved = ctx.saved_tensors  # asked for once: checkpoints refuse a second time
        with torch.no_grad():
            found = also_item_by_item(lambda *grads: _pull(ctx, saved, *grads), (grad_x, grad_v))
        return (None, *first_order("diffsim.soft_step", saved[0], found))


def _pull(
    ctx: Any, saved: tuple[Tensor, ...], grad_x: Tensor, grad_v: Tensor
) -> tuple[Tensor, ...]:
    """Gradients of x, v, force, activation, pressure and target."""
    solution, *tensors = saved
    prepared, bound, rates = ctx.prepared, ctx.bound, ctx.rates
    terms, muscles = prepared.terms(rates), prepared.body.muscles
    given = dict(zip(ctx.names, tensors, strict=True))
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
    of_muscles = found["activation"]
    if muscles.num_muscles:
        none = of_muscles.new_zeros(len(of_muscles), muscles.num_muscles)
        of_muscles = none.index_add_(1, muscles.owner, of_muscles)
    return (
        by_x,
        by_v * prepared.body.dt,
        found["force"].reshape(nodal),
        of_muscles.reshape(*lead, -1),
        found["pressure"].reshape(*lead, -1),
        found["target"].reshape(nodal),
    )
