"""One step among obstacles: half spaces from their shapes, then the solve under them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim import _ops_contact
from diffsim.contact import ContactPlanes, Obstacle, detect
from diffsim.soft.inputs import flat
from diffsim.soft.integrators import Stage
from diffsim.soft.problem import Problem, solver_arguments
from diffsim.soft.state import State

if TYPE_CHECKING:
    from diffsim.soft.body import SoftBody


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
    body: SoftBody, planes: ContactPlanes, state: State, problem: Problem
) -> tuple[Tensor, Tensor]:
    """The solution of a problem with half spaces; also the contact force on every node [N]."""
    if body.solver.method == "quasi_newton":
        raise ValueError(
            "solver method 'quasi_newton' does not handle obstacles; use 'auto', 'newton_pcg' "
            "(constant factor) or 'newton_cholesky'"
        )
    nodes, shape = body.contact_nodes, problem.y.shape
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
        problem.inputs(body),
        contacts,
        nodes,
        body.handle,
        body.solver.cache_columns,
        *solver_arguments(body.solver),
    )
    nodal = torch.zeros(shape, dtype=torch.float64)
    return x.reshape(shape), nodal.index_add(-2, nodes, force.reshape(vector))
