"""One time step as a function."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim import _ops_soft
from diffsim.errors import DiffsimError
from diffsim.soft.forces import elastic_gradient
from diffsim.soft.inputs import EMPTY, check_inputs, flat
from diffsim.soft.integrators import EXPLICIT, Stage, finish_stage, make_stage
from diffsim.soft.physics import Physics
from diffsim.soft.state import State

if TYPE_CHECKING:
    from diffsim.soft.body import SoftBody


def step(
    body: SoftBody,
    state: State,
    *,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
    physics: Physics | None = None,
) -> State:
    """One time step of a soft body (thesis eqs. 4.1-4.5) with its adjoint (eqs. 4.9, 4.10).

    Args:
        body: The body.
        state: x, v of shape (..., num_vertices, 3) [m], [m/s]; any leading batch axes.
        external_force: Nodal forces held over the step, broadcastable to x [N].
        activation: Muscle activations, broadcastable to (..., num_muscles) [-]; None: rest.
        pressure: Gauge pressures of the chambers, held over the step, broadcastable to
            (..., num_chambers) [Pa]; None: zero.
        dirichlet_target: Positions at the step's end, broadcastable to x [m], read at fixed
            entries; None: rest positions.
        physics: Parameters from ``body.physics(...)``; None: the body's own.

    Returns:
        The next state. Gradients: state, external_force, activation, pressure, dirichlet_target
        and every parameter in ``physics``; first order.

    Raises:
        TypeError, ValueError: wrong shape, dtype or non-finite input.
        ConvergenceError: the solver stopped above its tolerance (see ``body.solver.on_failure``).
    """
    physics = body.physics() if physics is None else physics
    x, force, target, activation, pressure = check_inputs(
        body, state, external_force, activation, pressure, dirichlet_target, physics
    )
    if body.integrator in EXPLICIT:
        return _explicit_step(body, state, x, force, target, activation, pressure, physics)
    stage = make_stage(body.integrator, body.dt, state)
    if stage.midpoint:
        target = 0.5 * (x + target)
    solution = _implicit(body, stage, state.x, force, target, activation, pressure, physics)
    return finish_stage(body.integrator, stage, state, solution, body.fixed)


def _implicit(
    body: SoftBody,
    stage: Stage,
    guess: Tensor,
    force: Tensor,
    target: Tensor,
    activation: Tensor,
    pressure: Tensor,
    physics: Physics,
) -> Tensor:
    """Solve the stage's problem; mass-proportional damping joins the inertia term."""
    alpha = physics.rayleigh_alpha * stage.kappa
    inertia = (stage.c + alpha) * physics.mass
    y = (stage.c * stage.y + alpha * stage.x_velocity) / (stage.c + alpha)
    damp_mu, damp_lambda = physics.damping(stage.kappa)
    frame = stage.y if damp_mu.numel() else None
    return solve(
        body,
        y=y,
        force=force,
        target=target,
        guess=guess,
        inertia=inertia,
        activation=activation,
        pressure=pressure,
        physics=physics,
        damping=(damp_mu, damp_lambda),
        x_frame=frame,
        x_velocity=stage.x_velocity if frame is not None else None,
    )


def solve(
    body: SoftBody,
    *,
    y: Tensor,
    force: Tensor,
    target: Tensor,
    guess: Tensor,
    inertia: Tensor,
    activation: Tensor,
    pressure: Tensor,
    physics: Physics,
    damping: tuple[Tensor, Tensor] = (EMPTY, EMPTY),
    x_frame: Tensor | None = None,
    x_velocity: Tensor | None = None,
) -> Tensor:
    """argmin 1/2 |x - y|^2_inertia - force.x + E(x) + D(x) - p V(x), x = target where fixed.

    The layer under every integrator and under statics; see csrc/kernels/soft/implicit_step.h. All
    states (..., num_vertices, 3), inertia (num_vertices,) [N/m].
    """
    shape = y.shape
    stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, activation)
    options = body.solver
    inputs = [
        flat(y),
        flat(force),
        flat(target),
        flat(guess.detach()),
        inertia.contiguous(),
        physics.w_mu,
        physics.w_vol,
        stiffness.contiguous(),
        flat(stretch, 1),
        *(d.contiguous() for d in damping),
        EMPTY if x_frame is None else flat(x_frame),
        EMPTY if x_velocity is None else flat(x_velocity),
        flat(pressure, 1),
    ]
    x, _ = _ops_soft.soft_step(
        inputs,
        body.handle,
        options.method,
        options.rtol,
        options.atol,
        options.max_iters,
        options.num_threads,
        options.on_failure,
        options.rtol if options.adjoint_rtol is None else options.adjoint_rtol,
        options.adjoint_max_iters,
    )
    return x.reshape(shape)


def _explicit_step(
    body: SoftBody,
    state: State,
    x: Tensor,
    force: Tensor,
    target: Tensor,
    activation: Tensor,
    pressure: Tensor,
    physics: Physics,
) -> State:
    """Semi-implicit Euler: v1 = v + h a(x, v), x1 = x + h v1; stable for h below 2 / w_max only."""
    gradient, _ = elastic_gradient(body, x, state.v, activation, pressure, physics)
    mass = physics.mass[:, None]
    v = state.v + body.dt * ((force - gradient) / mass - physics.rayleigh_alpha * state.v)
    v = torch.where(body.fixed, (target - x) / body.dt, v)
    x = x + body.dt * v
    if not torch.compiler.is_compiling() and not bool(torch.isfinite(x).all()):
        raise DiffsimError(
            f"explicit step became unstable at dt = {body.dt:g} s; reduce dt (stable below "
            "2 / largest angular frequency) or use an implicit integrator"
        )
    return State(x, v)
