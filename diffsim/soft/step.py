"""One time step as a function."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim import _ops_contact, _ops_soft
from diffsim.contact import ContactPlanes, Obstacle, detect
from diffsim.contact.obstacle import require_obstacles
from diffsim.errors import DiffsimError
from diffsim.soft.forces import elastic_gradient
from diffsim.soft.inputs import EMPTY, check_inputs, flat
from diffsim.soft.integrators import EXPLICIT, WITH_CONTACT, Stage, finish_stage, make_stage
from diffsim.soft.options import SolverOptions
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
    dirichlet_target: Tensor | None = None,
    obstacles: Sequence[Obstacle] | Obstacle | None = None,
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
        obstacles: What the body's contact nodes cannot enter, at their poses at the step's start
            (they move during the step); None: nothing. Complementarity with Coulomb friction and
            restitution, see docs/contact.md; with ``implicit_euler`` and ``bdf2``.
        physics: Parameters from ``body.physics(...)``; None: the body's own.

    Returns:
        The next state; with obstacles it carries the contact forces. Gradients: state,
        external_force, activation, dirichlet_target, every parameter in ``physics``, and the
        obstacles' friction, restitution, pose, motion and shape; first order. Where a contact is
        about to change (touch, slip) the gradient is that of the side it is on.

    Raises:
        TypeError, ValueError: wrong shape, dtype or non-finite input.
        ConvergenceError: the solver stopped above its tolerance (see ``body.solver.on_failure``).
    """
    physics = body.physics() if physics is None else physics
    x, force, target, activation = check_inputs(
        body, state, external_force, activation, dirichlet_target, physics
    )
    many = () if obstacles is None else require_obstacles(obstacles)
    if many and body.integrator not in WITH_CONTACT:
        raise ValueError(
            f"obstacles need one of the integrators {list(WITH_CONTACT)}, the body has "
            f"{body.integrator!r}; or use contact.penalty_force as an external force"
        )
    if body.integrator in EXPLICIT:
        return _explicit_step(body, state, x, force, target, activation, physics)
    stage = make_stage(body.integrator, body.dt, state)
    if stage.midpoint:
        target = 0.5 * (x + target)
    problem = _problem(body, stage, state.x, force, target, activation, physics)
    if not many:
        solution = solve(body, **problem)
        return finish_stage(body.integrator, stage, state, solution, body.fixed)
    planes = contact_planes(body, many, stage, state)
    solution, contact_force = solve_in_contact(body, planes, state, problem)
    end = finish_stage(body.integrator, stage, state, solution, body.fixed)
    return end._replace(contact_force=contact_force)


def _problem(
    body: SoftBody,
    stage: Stage,
    guess: Tensor,
    force: Tensor,
    target: Tensor,
    activation: Tensor,
    physics: Physics,
) -> dict:
    """Arguments of :func:`solve`; mass-proportional damping joins the inertia term."""
    alpha = physics.rayleigh_alpha * stage.kappa
    damping = physics.damping(stage.kappa)
    damped = damping[0].numel() > 0
    return {
        "y": (stage.c * stage.y + alpha * stage.x_velocity) / (stage.c + alpha),
        "force": force,
        "target": target,
        "guess": guess,
        "inertia": (stage.c + alpha) * physics.mass,
        "activation": activation,
        "physics": physics,
        "damping": damping,
        "x_frame": stage.y if damped else None,
        "x_velocity": stage.x_velocity if damped else None,
    }


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
    damping: tuple[Tensor, Tensor] = (EMPTY, EMPTY),
    x_frame: Tensor | None = None,
    x_velocity: Tensor | None = None,
) -> Tensor:
    """argmin 1/2 |x - y|^2_inertia - force.x + E(x) + D(x), x = target where fixed.

    The layer under every integrator and under statics; see csrc/kernels/soft/implicit_step.h. All
    states (..., num_vertices, 3), inertia (num_vertices,) [N/m].
    """
    x, _ = _ops_soft.soft_step(
        step_inputs(
            body,
            y=y,
            force=force,
            target=target,
            guess=guess,
            inertia=inertia,
            activation=activation,
            physics=physics,
            damping=damping,
            x_frame=x_frame,
            x_velocity=x_velocity,
        ),
        body.handle,
        *solver_arguments(body.solver),
    )
    return x.reshape(y.shape)


def step_inputs(
    body: SoftBody,
    *,
    y: Tensor,
    force: Tensor,
    target: Tensor,
    guess: Tensor,
    inertia: Tensor,
    activation: Tensor,
    physics: Physics,
    damping: tuple[Tensor, Tensor],
    x_frame: Tensor | None,
    x_velocity: Tensor | None,
) -> list[Tensor]:
    """The tensors of a step's problem in the order of ``STEP_INPUTS``, batch axes flattened."""
    stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, activation)
    return [
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
    ]


def solver_arguments(options: SolverOptions) -> tuple:
    """How the ops take the solver's options."""
    return (
        options.method,
        options.rtol,
        options.atol,
        options.max_iters,
        options.num_threads,
        options.on_failure,
        options.rtol if options.adjoint_rtol is None else options.adjoint_rtol,
        options.adjoint_max_iters,
    )


def contact_planes(
    body: SoftBody, obstacles: Sequence[Obstacle], stage: Stage, state: State
) -> ContactPlanes:
    """Half spaces of the body's contact nodes for one step, linearised at the inertial positions.

    ``reference`` is where a node would have the obstacle's velocity: the integrator's velocity is
    kappa (x - x_velocity), so the obstacle's displacement over the step counts by 1 / (kappa dt).
    """
    nodes = body.contact_nodes
    start = state.x[..., nodes, :]
    planes = detect(
        obstacles,
        start,
        stage.y[..., nodes, :],
        body.dt,
        max_depenetration_speed=body.max_depenetration_speed,
    )
    if body.integrator == "implicit_euler":
        return planes
    base = stage.x_velocity[..., nodes, :]
    reference = base + (planes.reference - start) / (stage.kappa * body.dt)
    shift = (planes.normal * (planes.reference - reference)).sum(-1)
    return planes._replace(reference=reference, offset=planes.offset + shift)


def solve_in_contact(
    body: SoftBody, planes: ContactPlanes, state: State, problem: dict
) -> tuple[Tensor, Tensor]:
    """:func:`solve` with half spaces; also the contact force on every node [N]."""
    if body.solver.method == "quasi_newton":
        raise ValueError(
            "solver method 'quasi_newton' does not handle obstacles; use 'auto', 'newton_pcg' "
            "(constant factor) or 'newton_cholesky'"
        )
    nodes, shape = body.contact_nodes, problem["y"].shape
    guess = state.contact_force
    guess = torch.zeros(shape, dtype=torch.float64) if guess is None else guess.detach()
    vector = (*shape[:-2], len(nodes), 3)
    contacts = [
        flat(planes.normal),
        flat(planes.reference),
        flat(planes.offset, 1),
        flat(planes.friction, 1),
        flat(guess[..., nodes, :].expand(vector)),
    ]
    x, force, _, _ = _ops_contact.contact_step(
        step_inputs(body, **problem),
        contacts,
        nodes,
        body.handle,
        body.solver.cache_columns,
        *solver_arguments(body.solver),
    )
    nodal = torch.zeros(shape, dtype=torch.float64)
    return x.reshape(shape), nodal.index_add(-2, nodes, force.reshape(vector))


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
    gradient, _ = elastic_gradient(body, x, state.v, activation, physics)
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
