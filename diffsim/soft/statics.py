"""Rest under load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from diffsim.contact import ContactPlanes, Obstacle, detect
from diffsim.contact.obstacle import require_obstacles
from diffsim.core.check import require
from diffsim.core.checked import checked
from diffsim.core.errors import ConvergenceError, ConvergenceWarning
from diffsim.core.numbers import values_of
from diffsim.core.record import warn
from diffsim.soft.in_contact import solve_in_contact
from diffsim.soft.inputs import Loads, check_inputs
from diffsim.soft.physics import Physics
from diffsim.soft.prepared import prepare
from diffsim.soft.problem import StepProblem, solve
from diffsim.soft.solid import Solid
from diffsim.soft.state import State

_MOST_ROUNDS = 50
_LEAST_SHARE = 1e-10  # of the body's size, that rounding leaves


@checked
def static_equilibrium(
    body: Solid,
    *,
    guess: Tensor | None = None,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
    obstacles: Sequence[Obstacle] | Obstacle | None = None,
    physics: Physics | None = None,
) -> State:
    """Positions where all forces balance: a minimum of energy.

    Elastic and muscle forces, gravity, external forces and pressures of chambers. A body whose
    steps are linearly implicit finds it by the method ``auto``.

    Args:
        body: The body; its Dirichlet set must hold it on every axis.
        guess: Start of the iteration, (..., num_nodes, 3) [m]; None: rest. Which of several
            equilibria is found depends on it; no gradient, but of where friction holds.
        obstacles: What contact nodes cannot enter; None: nothing. They move by their velocities
            over ``dt`` from where they are, and friction acts against slip since the guess: so
            equilibria one after another, each the guess of the next, are a slow motion.
        external_force, activation, pressure, dirichlet_target, physics: Loads, commands and
            parameters, as :func:`diffsim.soft.step` takes them.

    Returns:
        The state, v = 0; with obstacles it carries the contact forces. Gradients: external_force,
        activation, pressure, dirichlet_target, physics, and the obstacles' as in a step.

    Raises:
        FactorizationError: nothing holds the body.
        ConvergenceError: the solver stopped above its tolerance, or where nodes touch did not
            settle.
    """
    nodal = ("...", body.mesh.num_nodes, 3)
    prepared = prepare(body, physics)
    start = prepared.x_rest if guess is None else require("guess", guess, nodal)
    for name, given in (("external_force", external_force), ("dirichlet_target", dirichlet_target)):
        if given is None:
            continue
        require(name, given, nodal)
        if given.ndim > start.ndim:
            start = start.expand(*given.shape[:-2], *start.shape[-2:])
    for name, given in (("activation", activation), ("pressure", pressure)):
        if given is None:
            continue
        require(name, given, ("...", f"num_{'muscles' if name == 'activation' else 'chambers'}"))
        if given.ndim + 1 > start.ndim:
            start = start.expand(*given.shape[:-1], *start.shape[-2:])
    state = State(start, torch.zeros_like(start))
    x, loads = check_inputs(
        prepared,
        state,
        external_force=external_force,
        activation=activation,
        pressure=pressure,
        dirichlet_target=dirichlet_target,
    )
    many = () if obstacles is None else require_obstacles(obstacles)
    if many:
        return _rest_among(many, x, loads)
    x = solve(_problem(x, loads), iterate=True)
    return State(x, torch.zeros_like(x))


def _problem(guess: Tensor, loads: Loads) -> StepProblem:
    none = torch.zeros_like(loads.physics.mass)
    return StepProblem(y=guess.detach(), guess=guess, inertia=none, loads=loads)


def _rest_among(obstacles: Sequence[Obstacle], start: Tensor, loads: Loads) -> State:
    """Rest among obstacles, whose surfaces are linearized where the body was found, until it stays.

    The graph goes through all rounds, so that the gradient sees the surfaces' curvature.
    """
    body = loads.prepared.body
    still = [
        replace(obstacle, restitution=torch.zeros((), dtype=torch.float64))
        for obstacle in obstacles
    ]
    solver = replace(body.solver, method="auto") if loads.prepared.is_linear else body.solver
    share = max(solver.rtol, _LEAST_SHARE)

    def planes_at(x: Tensor) -> ContactPlanes:
        nodes = body.contact_nodes
        return detect(still, start[..., nodes, :], x[..., nodes, :], body.dt)

    planes, state = planes_at(start), State(start, torch.zeros_like(start))
    for _ in range(_MOST_ROUNDS):
        problem = _problem(state.x, loads)
        x, force = solve_in_contact(body, planes, state, problem, solver)
        state, last = State(x, torch.zeros_like(x), contact_force=force), planes
        planes = planes_at(x)
        with torch.no_grad():
            off = _contact_error(body, state, last, planes)
        if off <= share:
            return state
    message = (
        f"where nodes touch did not settle in {_MOST_ROUNDS} equilibria (off by {off:.1e} of the "
        "body's size); give a guess that is nearer, as by moving obstacles and loads in steps"
    )
    if solver.on_failure == "raise":
        raise ConvergenceError(message, residual_norm=off, tolerance=share, num_iters=_MOST_ROUNDS)
    warn(message, ConvergenceWarning)
    return state


def _contact_error(body: Solid, state: State, last: ContactPlanes, planes: ContactPlanes) -> float:
    """How far nodes are inside new half spaces, or off them and turned where they touch, as a share
    of the body's size."""
    nodes = body.contact_nodes
    gap = ((state.x[..., nodes, :] - planes.reference) * planes.normal).sum(-1) - planes.offset
    gap = gap / (body.x_rest.amax(0) - body.x_rest.amin(0)).max()
    turn = (planes.normal - last.normal).norm(dim=-1)
    assert state.contact_force is not None  # of solve_in_contact
    touches = (state.contact_force[..., nodes, :] != 0.0).any(-1)
    off = values_of(torch.where(touches, torch.maximum(gap.abs(), turn), (-gap).clamp(min=0.0)))
    return float(off.max()) if off.numel() else 0.0
