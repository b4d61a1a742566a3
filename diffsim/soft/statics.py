"""Rest under load."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.core.checked import checked
from diffsim.soft.inputs import check_inputs
from diffsim.soft.physics import Physics
from diffsim.soft.prepared import prepare
from diffsim.soft.problem import StepProblem, solve
from diffsim.soft.solid import Solid
from diffsim.soft.state import State


@checked
def static_equilibrium(
    body: Solid,
    *,
    guess: Tensor | None = None,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
    physics: Physics | None = None,
) -> State:
    """Positions where all forces balance: a minimum of energy.

    Elastic and muscle forces, gravity, external forces and pressures of chambers. A body whose
    steps are linearly implicit finds it by the method ``auto``.

    Args:
        body: The body; its Dirichlet set must hold it on every axis.
        guess: Start of the iteration, (..., num_nodes, 3) [m]; None: rest. Which of several
            equilibria is found depends on it; no gradient.
        external_force, activation, pressure, dirichlet_target, physics: Loads, commands and
            parameters, as :func:`diffsim.soft.step` takes them.

    Returns:
        The state, v = 0. Gradients: external_force, activation, pressure, dirichlet_target,
        physics.

    Raises:
        FactorizationError: nothing holds the body.
        ConvergenceError: the solver stopped above its tolerance.
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
    mass = loads.physics.mass
    problem = StepProblem(y=x.detach(), guess=x, inertia=torch.zeros_like(mass), loads=loads)
    x = solve(problem, iterate=True)
    return State(x, torch.zeros_like(x))
