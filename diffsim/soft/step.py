"""One time step as a function."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.contact import Obstacle
from diffsim.contact.obstacle import require_obstacles
from diffsim.core.errors import DiffsimError
from diffsim.core.torch_names import break_graph
from diffsim.soft._ops_step import LINEAR
from diffsim.soft.forces import elastic_gradient
from diffsim.soft.hydrodynamics import Hydrodynamics, SteadyWater
from diffsim.soft.in_contact import contact_planes, enters, in_contact, solve_in_contact
from diffsim.soft.inputs import DampingFrame, Loads, check_loads, check_state, flat
from diffsim.soft.integrators import (
    EXPLICIT,
    VELOCITY,
    WITH_CONTACT,
    finish_stage,
    make_stage,
)
from diffsim.soft.physics import Physics
from diffsim.soft.prepared import prepare
from diffsim.soft.problem import solve, stage_problem
from diffsim.soft.solid import Solid
from diffsim.soft.state import State
from diffsim.soft.whole_step import whole_step

BDF2_BREAKS_GRAPHS = (
    "BDF2 among obstacles asks at each step whether something touches, which breaks the graph: "
    "compile without fullgraph=True, or make the body with integrator='implicit_euler'"
)


def step(
    body: Solid,
    state: State,
    *,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
    obstacles: Sequence[Obstacle] | Obstacle | None = None,
    physics: Physics | None = None,
) -> State:
    """One time step of a soft body (thesis eqs. 4.1-4.5) with its adjoint (eqs. 4.9, 4.10).

    Args:
        body: The body.
        state: x, v of shape (..., num_nodes, 3) [m], [m/s]; any leading batch axes.
        external_force: Nodal forces held over the step, broadcastable to x [N].
        activation: Muscle activations, broadcastable to (..., num_muscles) [-]; None: rest.
        pressure: Gauge pressures of the chambers, held over the step, broadcastable to
            (..., num_chambers) [Pa]; None: zero.
        dirichlet_target: Positions at the step's end, broadcastable to x [m], read at fixed
            entries; None: rest positions.
        obstacles: What the body's contact nodes cannot enter, at their poses at the step's start
            (they move during the step); None: nothing. Complementarity with Coulomb friction and
            restitution, see docs/contact.md; with ``implicit_euler`` and ``bdf2``.
        physics: Parameters from ``body.physics(...)``; None: the body's own.

    Returns:
        The next state; with obstacles it carries the contact forces. Gradients: state,
        external_force, activation, pressure, dirichlet_target, every parameter in ``physics``, and
        the obstacles' friction, restitution, pose, motion and shape; first order. Where a contact
        is about to change (touch, slip) the gradient is that of the side it is on.

    Raises:
        TypeError, ValueError: wrong shape, dtype or non-finite input.
        ConvergenceError: the solver stopped above its tolerance (see ``body.solver.on_failure``).
    """
    prepared = prepare(body, physics)
    state = check_state(prepared, state)
    given = {
        "external_force": external_force,
        "activation": activation,
        "pressure": pressure,
        "dirichlet_target": dirichlet_target,
    }
    return advance(state, check_loads(prepared, state.x.shape, given), obstacles)


def step_in_water(
    body: Solid,
    state: State,
    water: Hydrodynamics,
    *,
    water_velocity: Tensor | None = None,
    gain: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    obstacles: Sequence[Obstacle] | Obstacle | None = None,
    physics: Physics | None = None,
) -> State:
    """One time step as :func:`step` takes it, under the force of water at its start.

    Args:
        body, state, activation, pressure, obstacles, physics: As in :func:`step`.
        water: Drag and thrust of the water.
        water_velocity: As ``water`` takes it.
        gain: Factor on its force, broadcastable to x; None: 1.

    Returns:
        The next state. Gradients: as those of both, first order.
    """
    prepared = prepare(body, physics)
    state = check_state(prepared, state)
    shape, loads = state.x.shape, {"activation": activation, "pressure": pressure}
    around = None if obstacles else SteadyWater.of(water, state.x, water_velocity, gain)
    if around is not None:
        whole = whole_step(state, check_loads(prepared, shape, loads), around)
        if whole is not None:
            return whole
    force = water(state.x, state.v, water_velocity=water_velocity)
    force = force if gain is None else gain * force
    return advance(
        state, check_loads(prepared, shape, {**loads, "external_force": force}), obstacles
    )


def advance(
    state: State, loads: Loads, obstacles: Sequence[Obstacle] | Obstacle | None = None
) -> State:
    """One time step from a checked state under checked loads; obstacles as for :func:`step`."""
    body = loads.prepared.body
    many = () if obstacles is None else require_obstacles(obstacles)
    if many and body.integrator not in WITH_CONTACT:
        raise ValueError(
            f"obstacles need one of the integrators {list(WITH_CONTACT)}, the body has "
            f"{body.integrator!r}; or use contact.penalty_force as an external force"
        )
    if many and loads.prepared.is_linear:
        raise ValueError(
            f"obstacles need a solver that iterates, the body has method={LINEAR!r}; use "
            "method='auto', or contact.penalty_force as an external force"
        )
    if body.integrator in EXPLICIT:
        return _explicit_step(body, state, loads)
    if many:
        return _contact_step(body, state, many, loads)
    return _free_step(body, state, loads)


def _free_step(body: Solid, state: State, loads: Loads) -> State:
    whole = whole_step(state, loads)
    if whole is not None:
        return whole
    stage = make_stage(body.integrator, body.dt, state)
    problem = stage_problem(stage, state.x, loads)
    return finish_stage(body.integrator, stage, state, solve(problem), body.fixed)


def _contact_step(body: Solid, state: State, obstacles: Sequence[Obstacle], loads: Loads) -> State:
    """A step among obstacles.

    BDF2 takes velocities from positions before an impact, and an impact forgets those: it is used
    in free flight only, and steps that touch are implicit Euler's.
    """
    if body.integrator == "bdf2" and torch.compiler.is_compiling():
        break_graph(BDF2_BREAKS_GRAPHS)
    if body.integrator == "bdf2" and not in_contact(state):
        stage = make_stage("bdf2", body.dt, state)
        planes = contact_planes(body, obstacles, state.x, stage.y)
        if not enters(body, planes, stage.y):
            end = _free_step(body, state, loads)
            if not enters(body, planes, end.x):
                return end._replace(contact_force=torch.zeros_like(end.x))
    stage = make_stage("implicit_euler", body.dt, state)
    planes = contact_planes(body, obstacles, state.x, stage.y)
    problem = stage_problem(stage, state.x, loads)
    solution, contact_force = solve_in_contact(body, planes, state, problem)
    end = finish_stage("implicit_euler", stage, state, solution, body.fixed)
    return end._replace(contact_force=contact_force)


def _explicit_step(body: Solid, state: State, loads: Loads) -> State:
    """Semi-implicit Euler: v1 = v + h a(x, v), x1 = x + h v1; stable for h below 2 / w_max only."""
    x, physics = state.x, loads.physics
    weights = loads.prepared.terms(VELOCITY).damping
    frame = DampingFrame(weights=weights, x_frame=flat(x), x_velocity=flat(x - state.v))
    gradient, _ = elastic_gradient(x, loads, frame)
    mass, alpha = physics.mass[..., None], physics.rayleigh_alpha[..., None, None]
    v = state.v + body.dt * ((loads.force - gradient) / mass - alpha * state.v)
    target = loads.target
    v = torch.where(body.fixed, (target - x) / body.dt, v)
    x = x + body.dt * v
    if not torch.compiler.is_compiling() and not bool(torch.isfinite(x).all()):
        raise DiffsimError(
            f"explicit step became unstable at dt = {body.dt:g} s; reduce dt (stable below "
            "2 / largest angular frequency) or use an implicit integrator"
        )
    return State(x, v)
