"""What every function of a body checks and broadcasts before a kernel sees it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.soft.physics import Physics, require_physics
from diffsim.soft.state import State, require_state

if TYPE_CHECKING:
    from diffsim.soft.body import SoftBody

EMPTY = torch.zeros(0, dtype=torch.float64)


def check_inputs(
    body: SoftBody,
    state: State,
    external_force: Tensor | None,
    activation: Tensor | None,
    pressure: Tensor | None,
    dirichlet_target: Tensor | None,
    physics: Physics,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Checked and broadcast x, total force, Dirichlet target, activation, pressure."""
    num_vertices = body.mesh.num_vertices
    require_physics(physics, num_vertices, body.mesh.num_elements, body.material)
    require_state(state)
    x = require("state.x", state.x, ("...", num_vertices, 3))
    require("state.v", state.v, tuple(x.shape))
    for name in ("x_prev", "v_prev", "contact_force"):
        value = getattr(state, name)
        if value is not None:
            require(f"state.{name}", value, tuple(x.shape))
    force = physics.weighing_mass[:, None] * physics.gravity
    if external_force is not None:
        force = force + require("external_force", external_force, ("...", num_vertices, 3))
    force = broadcast("external_force", force, x.shape)
    if dirichlet_target is None:
        target = body.x_rest.expand(x.shape)
    else:
        target = require("dirichlet_target", dirichlet_target, ("...", num_vertices, 3))
        target = broadcast("dirichlet_target", target, x.shape)
    count = body.muscles.num_muscles
    if activation is None:
        activation = body.muscles.rest_activation
    elif not count:
        raise ValueError("activation was given, but the body has no muscles")
    activation = require("activation", activation, ("...", count))
    activation = broadcast("activation", activation, (*x.shape[:-2], count))
    count = body.chambers.num_chambers
    if pressure is None:
        pressure = x.new_zeros(count)
    elif not count:
        raise ValueError("pressure was given, but the body has no chambers")
    pressure = require("pressure", pressure, ("...", count))
    return x, force, target, activation, broadcast("pressure", pressure, (*x.shape[:-2], count))


def broadcast(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """``value`` expanded to ``shape``, or an error that names it."""
    try:
        return value.expand(shape)
    except RuntimeError as err:
        raise ValueError(
            f"{name} must broadcast to {tuple(shape)}, got {tuple(value.shape)}; its leading axes "
            "must match the state's batch axes"
        ) from err


def flat(value: Tensor, trailing: int = 2) -> Tensor:
    """(batch, ...) with one leading axis, contiguous."""
    batch = math.prod(value.shape[: value.ndim - trailing])
    return value.reshape(batch, *value.shape[value.ndim - trailing :]).contiguous()
