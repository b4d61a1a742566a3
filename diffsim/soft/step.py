"""One time step as a function, and the elastic force and energy by themselves."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim import _ops_soft
from diffsim._check import require
from diffsim.errors import DiffsimError
from diffsim.soft.integrators import EXPLICIT, Stage, finish_stage, make_stage
from diffsim.soft.physics import Physics, require_physics
from diffsim.soft.state import State, require_state

if TYPE_CHECKING:
    from diffsim.soft.body import SoftBody

_EMPTY = torch.zeros(0, dtype=torch.float64)


def step(
    body: SoftBody,
    state: State,
    *,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
    physics: Physics | None = None,
) -> State:
    """One time step of a soft body (thesis eqs. 4.1-4.5) with its adjoint (eqs. 4.9, 4.10).

    Args:
        body: The body.
        state: x, v of shape (..., num_vertices, 3) [m], [m/s]; any leading batch axes.
        external_force: Nodal forces held over the step, broadcastable to x [N].
        activation: Muscle activations, broadcastable to (..., num_muscles) [-]; None: rest.
        dirichlet_target: Positions at the step's end, broadcastable to x [m], read at fixed
            entries; None: rest positions.
        physics: Parameters from ``body.physics(...)``; None: the body's own.

    Returns:
        The next state. Gradients: state, external_force, activation, dirichlet_target and every
        parameter in ``physics``; first order.

    Raises:
        TypeError, ValueError: wrong shape, dtype or non-finite input.
        ConvergenceError: the solver stopped above its tolerance (see ``body.solver.on_failure``).
    """
    physics = body.physics() if physics is None else physics
    x, force, target, activation = _inputs(
        body, state, external_force, activation, dirichlet_target, physics
    )
    if body.integrator in EXPLICIT:
        return _explicit_step(body, state, x, force, target, activation, physics)
    stage = make_stage(body.integrator, body.dt, state)
    if stage.midpoint:
        target = 0.5 * (x + target)
    solution = _implicit(body, stage, state.x, force, target, activation, physics)
    return finish_stage(body.integrator, stage, state, solution, body.fixed)


def _inputs(
    body: SoftBody,
    state: State,
    external_force: Tensor | None,
    activation: Tensor | None,
    dirichlet_target: Tensor | None,
    physics: Physics,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Checked and broadcast x, total force, Dirichlet target, activation."""
    num_vertices = body.mesh.num_vertices
    require_physics(physics, num_vertices, body.mesh.num_elements)
    require_state(state)
    x = require("state.x", state.x, ("...", num_vertices, 3))
    require("state.v", state.v, tuple(x.shape))
    for name in ("x_prev", "v_prev"):
        value = getattr(state, name)
        if value is not None:
            require(f"state.{name}", value, tuple(x.shape))
    force = physics.mass[:, None] * physics.gravity
    if external_force is not None:
        force = force + require("external_force", external_force, ("...", num_vertices, 3))
    force = _broadcast("external_force", force, x.shape)
    if dirichlet_target is None:
        target = body.x_rest.expand(x.shape)
    else:
        target = require("dirichlet_target", dirichlet_target, ("...", num_vertices, 3))
        target = _broadcast("dirichlet_target", target, x.shape)
    count = body.muscles.num_muscles
    if activation is None:
        activation = body.muscles.rest_activation
    elif not count:
        raise ValueError("activation was given, but the body has no muscles")
    activation = require("activation", activation, ("...", count))
    return x, force, target, _broadcast("activation", activation, (*x.shape[:-2], count))


def _broadcast(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    try:
        return value.expand(shape)
    except RuntimeError as err:
        raise ValueError(
            f"{name} must broadcast to {tuple(shape)}, got {tuple(value.shape)}; its leading axes "
            "must match the state's batch axes"
        ) from err


def _implicit(
    body: SoftBody,
    stage: Stage,
    guess: Tensor,
    force: Tensor,
    target: Tensor,
    activation: Tensor,
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
    physics: Physics,
    damping: tuple[Tensor, Tensor] = (_EMPTY, _EMPTY),
    x_frame: Tensor | None = None,
    x_velocity: Tensor | None = None,
) -> Tensor:
    """argmin 1/2 |x - y|^2_inertia - force.x + E(x) + D(x), x = target where fixed.

    The layer under every integrator and under statics; see csrc/kernels/soft/implicit_step.h. All
    states (..., num_vertices, 3), inertia (num_vertices,) [N/m].
    """
    shape = y.shape
    stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, activation)
    options = body.solver
    x, _ = _ops_soft.soft_step(
        _flat(y),
        _flat(force),
        _flat(target),
        _flat(guess.detach()),
        inertia.contiguous(),
        physics.w_mu,
        physics.w_vol,
        stiffness.contiguous(),
        _flat(stretch, 1),
        *(d.contiguous() for d in damping),
        _EMPTY if x_frame is None else _flat(x_frame),
        _EMPTY if x_velocity is None else _flat(x_velocity),
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


def _flat(value: Tensor, trailing: int = 2) -> Tensor:
    """(batch, ...) with one leading axis, contiguous."""
    batch = math.prod(value.shape[: value.ndim - trailing])
    return value.reshape(batch, *value.shape[value.ndim - trailing :]).contiguous()


def _explicit_step(
    body: SoftBody,
    state: State,
    x: Tensor,
    force: Tensor,
    target: Tensor,
    activation: Tensor,
    physics: Physics,
) -> State:
    """Semi-implicit Euler: v1 = v + h a(x, v), x1 = x + h v1; stable for h below 2 / w_max only."""
    elastic = _force(body, x, state.v, activation, physics)
    mass = physics.mass[:, None]
    v = state.v + body.dt * ((elastic + force) / mass - physics.rayleigh_alpha * state.v)
    v = torch.where(body.fixed, (target - x) / body.dt, v)
    x = x + body.dt * v
    if not torch.compiler.is_compiling() and not bool(torch.isfinite(x).all()):
        raise DiffsimError(
            f"explicit step became unstable at dt = {body.dt:g} s; reduce dt (stable below "
            "2 / largest angular frequency) or use an implicit integrator"
        )
    return State(x, v)


def _force(
    body: SoftBody, x: Tensor, v: Tensor | None, activation: Tensor, physics: Physics
) -> Tensor:
    """Elastic and, with a velocity, damping force."""
    stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, activation)
    damp_mu, damp_lambda, frame, x_velocity = _EMPTY, _EMPTY, _EMPTY, _EMPTY
    if v is not None and physics.rayleigh_beta is not None:
        damp_mu, damp_lambda = physics.damping(1.0)
        frame, x_velocity = _flat(x), _flat(x - v)
    gradient, _ = _ops_soft.elastic_gradient(
        _flat(x),
        physics.w_mu,
        physics.w_vol,
        stiffness.contiguous(),
        _flat(stretch, 1),
        damp_mu.contiguous(),
        damp_lambda.contiguous(),
        frame,
        x_velocity,
        body.handle,
        body.solver.num_threads,
    )
    return -gradient.reshape(x.shape)


def elastic_force(
    body: SoftBody,
    x: Tensor,
    *,
    activation: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Elastic and muscle force -dE/dx (thesis eq. 4.16).

    Args:
        body: The body.
        x: Positions, (..., num_vertices, 3) [m].
        activation: Muscle activations, broadcastable to (..., num_muscles); None: rest.
        physics: Parameters; None: the body's own.

    Returns:
        Forces, shape of x [N]. Gradients: x, activation, physics; first order.
    """
    physics = body.physics() if physics is None else physics
    x = require("x", x, ("...", body.mesh.num_vertices, 3))
    state = State(x, torch.zeros_like(x))
    x, _, _, activation = _inputs(body, state, None, activation, None, physics)
    return _force(body, x, None, activation, physics)


def elastic_energy(
    body: SoftBody,
    x: Tensor,
    *,
    activation: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Elastic and muscle energy.

    Args:
        As in :func:`elastic_force`.

    Returns:
        Energies, (...) [J]. Gradient: x only (parameters are treated as constants).
    """
    physics = body.physics() if physics is None else physics
    x = require("x", x, ("...", body.mesh.num_vertices, 3))
    state = State(x, torch.zeros_like(x))
    x, _, _, activation = _inputs(body, state, None, activation, None, physics)
    stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, activation)
    _, energy = _ops_soft.elastic_gradient(
        _flat(x),
        physics.w_mu.detach(),
        physics.w_vol.detach(),
        stiffness.detach().contiguous(),
        _flat(stretch.detach(), 1),
        _EMPTY,
        _EMPTY,
        _EMPTY,
        _EMPTY,
        body.handle,
        body.solver.num_threads,
    )
    return energy.reshape(x.shape[:-2])
