"""What every function of a body checks, broadcasts and flattens before a kernel sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.soft._arrays import EnergyArrays
from diffsim.soft.physics import Physics, require_physics
from diffsim.soft.solid import Solid
from diffsim.soft.state import State, require_state

EMPTY = torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Loads:
    """What acts on a body in one step, checked, with the batch axes of the state.

    Attributes:
        force: External forces and weight, (..., num_nodes, 3) [N].
        target: Positions of Dirichlet nodes, (..., num_nodes, 3) [m].
        activation: Activations of the muscles, (..., num_muscles) [-].
        pressure: Gauge pressures of the chambers, (..., num_chambers) [Pa].
        physics: The body's parameters.
    """

    force: Tensor
    target: Tensor
    activation: Tensor
    pressure: Tensor
    physics: Physics


@dataclass(frozen=True, kw_only=True, eq=False)
class DampingFrame:
    """What stiffness-proportional damping refers to, see csrc/kernels/soft/damping.h.

    Attributes:
        kappa: Velocity per displacement [1/s]: v = kappa (x - x_velocity).
        x_frame: Positions that define the frame, (..., num_nodes, 3) [m].
        x_velocity: Positions that velocity is measured from, (..., num_nodes, 3) [m].
    """

    kappa: float
    x_frame: Tensor
    x_velocity: Tensor


def check_inputs(
    body: Solid,
    state: State,
    physics: Physics,
    *,
    external_force: Tensor | None = None,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    dirichlet_target: Tensor | None = None,
) -> tuple[Tensor, Loads]:
    """Positions (..., num_nodes, 3) [m] of a state, and what acts on it; see ``step``."""
    num_nodes = body.mesh.num_nodes
    require_physics(physics, num_nodes, body.mesh.num_elements, body.material.law)
    require_state(state)
    x = require("state.x", state.x, ("...", num_nodes, 3))
    require("state.v", state.v, tuple(x.shape))
    for name in ("x_prev", "v_prev", "contact_force"):
        value = getattr(state, name)
        if value is not None:
            require(f"state.{name}", value, tuple(x.shape))
    if physics.batch is not None and tuple(x.shape[:-2]) != (physics.batch,):
        raise ValueError(
            f"state.x must have the batch axis ({physics.batch},) of physics(batch=...), got "
            f"{tuple(x.shape[:-2])}; begin with body.rest_state(batch={physics.batch})"
        )
    force = physics.weighing_mass[..., None] * physics.gravity.unsqueeze(-2)
    if external_force is not None:
        force = force + require("external_force", external_force, ("...", num_nodes, 3))
    target = body.x_rest
    if dirichlet_target is not None:
        target = require("dirichlet_target", dirichlet_target, ("...", num_nodes, 3))
    batch = x.shape[:-2]
    return x, Loads(
        force=broadcast("external_force", force, x.shape),
        target=broadcast("dirichlet_target", target, x.shape),
        activation=_signal(
            "activation", activation, "muscles", body.muscles.rest_activation, batch
        ),
        pressure=_signal(
            "pressure", pressure, "chambers", x.new_zeros(body.chambers.num_chambers), batch
        ),
        physics=physics,
    )


def _signal(
    name: str, value: Tensor | None, of: str, rest: Tensor, batch: tuple[int, ...]
) -> Tensor:
    """One number for each muscle or chamber, (..., size); ``rest`` (size,) where none is given."""
    if value is not None and not len(rest):
        raise ValueError(f"{name} was given, but the body has no {of}")
    value = require(name, rest if value is None else value, ("...", len(rest)))
    return broadcast(name, value, (*batch, len(rest)))


def energy_arrays(body: Solid, loads: Loads, frame: DampingFrame | None = None) -> EnergyArrays:
    """Parameters of the energy as the ops take them, batch axes flattened.

    Args:
        body: The body.
        loads: Activations, pressures and physics.
        frame: Reference of damping; None: the energy without damping.
    """
    physics = loads.physics
    fibers = body.muscles.fibers(physics.fiber_stiffness, loads.activation)
    damping = None if frame is None else physics.damping(frame.kappa)
    stiffness = fibers.stiffness
    if physics.batch is not None and stiffness.ndim == 1:  # no fibers
        stiffness = stiffness.expand(physics.batch, -1)
    terms = dict.fromkeys(("damp_mu", "damp_lambda", "x_frame", "x_velocity"), EMPTY)
    if frame is not None and damping is not None:
        terms = {
            "damp_mu": damping.mu.contiguous(),
            "damp_lambda": damping.lame_lambda.contiguous(),
            "x_frame": flat(frame.x_frame),
            "x_velocity": flat(frame.x_velocity),
        }
    return EnergyArrays(
        w_mu=physics.w_mu.contiguous(),
        w_vol=physics.w_vol.contiguous(),
        fiber_stiffness=stiffness.contiguous(),
        activation=flat(fibers.stretch, 1),
        pressure=flat(loads.pressure, 1),
        **terms,
    )


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
