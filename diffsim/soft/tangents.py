"""Forward mode: how a rollout changes along many directions of its inputs, in one sweep.

A converged step solves R(x1, p) = 0. With the step's tangent matrix H = dR/dx1 factorized once,
every direction costs one more right-hand side, H dx1 = -dR/dp dp (the transpose of thesis eqs.
4.9, 4.10), where p are the state, loads, commands and parameters. What integrators do before and
after the solve is linear in the state, so the same functions serve states and their tangents.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.core.check import require, require_constants, require_count
from diffsim.core.checked import checked
from diffsim.soft.inputs import LOADS, Loads, check_inputs, check_state
from diffsim.soft.integrators import IMPLICIT, finish_stage, make_stage
from diffsim.soft.physics import Physics
from diffsim.soft.physics_tangent import as_damped_as, still_physics
from diffsim.soft.prepared import PreparedBody
from diffsim.soft.problem import StepProblem, stage_problem
from diffsim.soft.problem_tangent import Changing, load_rates, solve_along, stage_rates
from diffsim.soft.rollout import LoadsInTime, Signal
from diffsim.soft.solid import Solid
from diffsim.soft.state import State, require_state

Moving = Tensor | Callable[[int, State, State], Tensor] | None

_ONE_WAY = "tangents are computed without a graph; or call under torch.no_grad()"


@checked(kinds_only=True)
@dataclass(frozen=True, kw_only=True)
class Directions:
    """K directions in the inputs of a rollout; None: nothing moves.

    Signals are tensors, or ``f(step, state, tangent)`` with the tangent's x and v (K, ...).

    Attributes:
        x, v: Directions of the initial positions and velocities, (K, num_nodes, 3) [m], [m/s]
            per unit of a direction.
        external_force: Directions of the nodal forces, (K, num_nodes, 3) [N].
        activation: Directions of the muscles' activations, (K, num_muscles).
        pressure: Directions of the chambers' pressures, (K, num_chambers) [Pa].
        dirichlet_target: Directions of the prescribed positions, (K, num_nodes, 3) [m].
        physics: A :class:`~diffsim.soft.Physics` whose tensors are derivatives with a leading K,
            see :func:`physics_directions`.
    """

    x: Tensor | None = None
    v: Tensor | None = None
    external_force: Moving = None
    activation: Moving = None
    pressure: Moving = None
    dirichlet_target: Moving = None
    physics: Physics | None = None


class Tangents(NamedTuple):
    """What :func:`rollout_tangents` returns.

    Attributes:
        x: Positions, or what ``keep`` keeps, (num_steps + 1, ...), the first ones first.
        tangent: Their derivatives, (num_steps + 1, K, ...).
        final: The last state.
        final_tangent: Its derivatives, (K, num_nodes, 3) each.
    """

    x: Tensor
    tangent: Tensor
    final: State
    final_tangent: State


@checked
def rollout_tangents(
    body: Solid,
    state: State,
    num_steps: int,
    count: int,
    directions: Directions,
    *,
    external_force: Signal = None,
    activation: Signal = None,
    pressure: Signal = None,
    dirichlet_target: Signal = None,
    physics: Physics | None = None,
    keep: Callable[[State, State], tuple[Tensor, Tensor]] | None = None,
) -> Tangents:
    """A rollout and its derivatives along ``count`` directions, without a graph.

    For few outputs and many inputs take the adjoint, ``rollout(...)`` and ``backward()``; for
    many outputs and some hundred inputs this. Not with obstacles, nor with explicit integrators.

    Args:
        body: The body.
        state: Initial state, (num_nodes, 3).
        num_steps: Number of steps, >= 1.
        count: Number of directions, K >= 1.
        directions: Directions in the state, the signals and the parameters.
        external_force, activation, pressure, dirichlet_target, physics: Inputs of the rollout, as
            :func:`diffsim.soft.rollout` takes them.
        keep: Function of a state and its tangent: what is kept instead of x, and its derivatives
            with a leading K, for example ``lambda s, t: (s.x[tip], t.x[:, tip])``.

    Returns:
        :class:`Tangents`.

    Raises:
        ValueError: the body's integrator is explicit, or a shape is wrong.
        ConvergenceError: a step or a tangent's solve stopped above its tolerance.
    """
    if body.integrator not in IMPLICIT:
        raise ValueError(
            f"tangents need one of the integrators {list(IMPLICIT)}, the body has "
            f"{body.integrator!r}; differentiate it with rollout and backward()"
        )
    require_count("num_steps", num_steps, at_least=1)
    shape = (body.mesh.num_nodes, 3)
    require("state.x", require_state(state).x, shape)
    if state.contact_force is not None:
        raise ValueError("state has contact forces; tangents are for bodies without obstacles")
    zero = torch.zeros(count, *shape, dtype=torch.float64)
    moving = State(
        zero if directions.x is None else require("directions.x", directions.x, zero.shape),
        zero if directions.v is None else require("directions.v", directions.v, zero.shape),
        None if state.x_prev is None else zero,
        None if state.v_prev is None else zero,
    )
    signals = {
        "external_force": external_force,
        "activation": activation,
        "pressure": pressure,
        "dirichlet_target": dirichlet_target,
    }
    physics = body.physics() if physics is None else physics
    require_constants(_ONE_WAY, state=state, directions=directions, physics=physics, **signals)
    directed = directions.physics or still_physics(physics, count)
    directions = _follow_shape(directions, dirichlet_target)
    keep = keep or (lambda state, moving: (state.x, moving.x))
    kept = [keep(state, moving)]
    with torch.no_grad():
        prepared = PreparedBody(body, as_damped_as(directed, physics))
        state = check_state(prepared, state)
        changing = Changing(prepared, directed)
        loads_at = LoadsInTime(prepared, shape, signals)
        moved_at = _MovedInTime(body, directions, count)
        for k in range(num_steps):
            moved = moved_at(k, state, moving)
            state, moving = _step(state, moving, loads_at(k, state), moved, changing)
            kept.append(keep(state, moving))
    return Tangents(
        torch.stack([x for x, _ in kept]), torch.stack([t for _, t in kept]), state, moving
    )


@checked(x=("num_nodes", 3))
def static_tangents(
    body: Solid,
    x: Tensor,
    count: int,
    directions: Directions,
    *,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Derivatives of a static equilibrium along ``count`` directions.

    Args:
        body: The body.
        x: The equilibrium, (num_nodes, 3) [m], of the same inputs.
        count: Number of directions, K >= 1.
        directions: Directions in loads, commands and parameters, as tensors; ``x`` and ``v`` are
            not read.
        external_force, activation, pressure, dirichlet_target, physics: Inputs of the
            equilibrium, as :func:`diffsim.soft.static_equilibrium` takes them.

    Returns:
        (K, num_nodes, 3) [m] per unit of each direction.
    """
    physics = body.physics() if physics is None else physics
    loads_given = {
        "external_force": external_force,
        "activation": activation,
        "pressure": pressure,
        "dirichlet_target": dirichlet_target,
    }
    require_constants(_ONE_WAY, x=x, directions=directions, physics=physics, **loads_given)
    directed = directions.physics or still_physics(physics, count)
    directions = _follow_shape(directions, dirichlet_target)
    state = State(x, torch.zeros_like(x))
    with torch.no_grad():
        prepared = PreparedBody(body, physics)
        x, loads = check_inputs(prepared, state, **loads_given)
        problem = StepProblem(y=x, guess=x, inertia=torch.zeros_like(physics.mass), loads=loads)
        still = State(torch.zeros(count, *x.shape, dtype=x.dtype), torch.zeros(0))
        moved = _MovedInTime(body, directions, count)(0, state, still)
        rates = load_rates(problem, moved, Changing(prepared, directed))
        return solve_along(prepared, problem.arrays(), x, rates)


def _follow_shape(directions: Directions, target: Signal) -> Directions:
    """Directions in which what is held at rest moves with a rest shape that moves."""
    physics = directions.physics
    if physics is None or physics.x_rest is None or target is not None:
        return directions
    if directions.dirichlet_target is not None:
        return directions
    return replace(directions, dirichlet_target=physics.x_rest)


class _MovedInTime:
    """How loads move in each step, checked; what no step changes is checked once.

    Args:
        directions: K directions of the inputs.
        count: Number K of directions.
    """

    def __init__(self, body: Solid, directions: Directions, count: int):
        nodal = (count, body.mesh.num_nodes, 3)
        self._shapes = {
            "external_force": nodal,
            "dirichlet_target": nodal,
            "activation": (count, body.muscles.num_muscles),
            "pressure": (count, body.chambers.num_chambers),
        }
        given = {name: getattr(directions, name) for name in LOADS}
        self._moving = {n: f for n, f in given.items() if callable(f)}
        self._still = {n: self._check_rate(n, r) for n, r in given.items() if n not in self._moving}

    def __call__(self, k: int, state: State, tangent: State) -> dict[str, Tensor | None]:
        """Directions of all ``LOADS`` by name; None: it does not move."""
        moving = {n: self._check_rate(n, f(k, state, tangent)) for n, f in self._moving.items()}
        return self._still | moving

    def _check_rate(self, name: str, rate: Tensor | None) -> Tensor | None:
        return None if rate is None else require(f"directions.{name}", rate, self._shapes[name])


def _step(
    state: State,
    moving: State,
    loads: Loads,
    moved: Mapping[str, Tensor | None],
    changing: Changing,
) -> tuple[State, State]:
    """The next state and its tangents, as :func:`diffsim.soft.step` makes them."""
    prepared, body = loads.prepared, loads.prepared.body
    stage = make_stage(body.integrator, body.dt, state)
    problem = stage_problem(stage, state.x, loads)
    arrays = problem.arrays()
    solution = prepared.solve(arrays)[0]
    d_stage = make_stage(body.integrator, body.dt, moving)
    rates = stage_rates(problem, stage, d_stage, moving, moved, changing)
    d_solution = solve_along(prepared, arrays, solution, rates)
    return (
        finish_stage(body.integrator, stage, state, solution, body.fixed),
        finish_stage(body.integrator, d_stage, moving, d_solution, body.fixed),
    )
