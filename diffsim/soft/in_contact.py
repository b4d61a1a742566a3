"""One step among obstacles: half spaces from their shapes, then the solve under them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.contact import ContactPlanes, Obstacle, detect
from diffsim.soft import _ops_contact
from diffsim.soft._arrays import ContactArrays
from diffsim.soft.inputs import flat
from diffsim.soft.options import SolverOptions
from diffsim.soft.problem import StepProblem
from diffsim.soft.solid import Solid
from diffsim.soft.state import State


def contact_planes(
    body: Solid, obstacles: Sequence[Obstacle], x: Tensor, y: Tensor
) -> ContactPlanes:
    """Half spaces of the contact nodes for a step from x to about y, (..., num_nodes, 3) [m]."""
    nodes = body.contact_nodes
    return detect(
        obstacles,
        x[..., nodes, :],
        y[..., nodes, :],
        body.dt,
        max_depenetration_speed=body.max_depenetration_speed,
    )


def in_contact(state: State) -> bool:
    """Whether obstacles acted in the step that led to a state."""
    return state.contact_force is not None and bool((state.contact_force != 0.0).any())


def enters(body: Solid, planes: ContactPlanes, x: Tensor) -> bool:
    """Whether any contact node lies outside its half space at x."""
    away = x[..., body.contact_nodes, :] - planes.reference
    return bool(((planes.normal * away).sum(-1) < planes.offset).any())


def solve_in_contact(
    body: Solid,
    planes: ContactPlanes,
    state: State,
    problem: StepProblem,
    solver: SolverOptions | None = None,
) -> tuple[Tensor, Tensor]:
    """The solution of a problem with half spaces; also the contact force on every node [N]."""
    solver = body.solver if solver is None else solver
    if solver.method == "quasi_newton":
        raise ValueError(
            "solver method 'quasi_newton' does not handle obstacles; use 'auto', 'newton_pcg' "
            "(constant factor) or 'newton_cholesky'"
        )
    nodes, shape = body.contact_nodes, problem.y.shape
    guess = state.contact_force
    guess = torch.zeros(shape, dtype=torch.float64) if guess is None else guess.detach()
    vector = (*shape[:-2], len(nodes), 3)
    contacts = ContactArrays(
        normal=flat(planes.normal),
        reference=flat(planes.reference),
        offset=flat(planes.offset, 1),
        friction=flat(planes.friction, 1),
        force_guess=flat(guess[..., nodes, :].expand(vector)),
    )
    x, force, _, _ = _ops_contact.contact_step(
        *problem.arrays().tensors(),
        *contacts.tensors(),
        nodes,
        handle=body.handle,
        cache_columns=solver.cache_columns,
        **solver.arguments(),
    )
    nodal = torch.zeros(shape, dtype=torch.float64)
    return x.reshape(shape), nodal.index_add(-2, nodes, force.reshape(vector))
