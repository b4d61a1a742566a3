"""What every function of a body checks, broadcasts and flattens before a kernel sees it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.soft._arrays import EnergyArrays
from diffsim.soft.physics import DampingWeights, Physics
from diffsim.soft.prepared import PreparedBody
from diffsim.soft.state import State, require_state

EMPTY = torch.zeros(0, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class Loads:
    """What acts on a body in one step, checked, with the batch axes of the state."""

    force: Tensor  # external forces and weight, (..., num_nodes, 3) [N]
    target: Tensor  # positions of Dirichlet nodes, (..., num_nodes, 3) [m]
    activation: Tensor  # activations of the muscles, (..., num_muscles) [-]
    pressure: Tensor  # gauge pressures of the chambers, (..., num_chambers) [Pa]
    prepared: PreparedBody

    @property
    def physics(self) -> Physics:
        """The body's parameters."""
        return self.prepared.physics

    def with_target(self, target: Tensor) -> Loads:
        """The same loads with other positions of the Dirichlet nodes."""
        return replace(self, target=target)

    def with_force(self, force: Tensor) -> Loads:
        """The same loads with other forces."""
        return replace(self, force=force)


@dataclass(frozen=True, kw_only=True, eq=False)
class DampingFrame:
    """What stiffness-proportional damping refers to, see csrc/kernels/soft/damping.h."""

    weights: DampingWeights | None  # of the elements; None: no damping
    x_frame: Tensor  # positions that define the frame, (..., num_nodes, 3) [m]
    x_velocity: Tensor  # positions that velocity is measured from, (..., num_nodes, 3) [m]


def check_inputs(
    prepared: PreparedBody, state: State, **given: Tensor | None
) -> tuple[Tensor, Loads]:
    """Positions (..., num_nodes, 3) [m] of a state, and what acts on it; see ``step``."""
    x = check_state(prepared, state).x
    return x, check_loads(prepared, x.shape, given)


def check_state(prepared: PreparedBody, state: State) -> State:
    """The state, contiguous; refuses what a step cannot begin from."""
    physics = prepared.physics
    require_state(state)
    x = require("state.x", state.x, ("...", prepared.body.mesh.num_nodes, 3))
    checked = {"x": x, "v": require("state.v", state.v, tuple(x.shape))}
    for name in ("x_prev", "v_prev", "contact_force"):
        value = getattr(state, name)
        if value is not None:
            checked[name] = require(f"state.{name}", value, tuple(x.shape))
    if physics.batch is not None and tuple(x.shape[:-2]) != (physics.batch,):
        raise ValueError(
            f"state.x must have the batch axis ({physics.batch},) of physics(batch=...), got "
            f"{tuple(x.shape[:-2])}; begin with body.rest_state(batch={physics.batch})"
        )
    return state._replace(**checked)


def check_loads(
    prepared: PreparedBody, shape: tuple[int, ...], given: Mapping[str, Tensor | None]
) -> Loads:
    """What acts in a step.

    Args:
        shape: Of the positions, (..., num_nodes, 3).
        given: ``LOADS`` by name, as ``step`` takes them; None and what is missing: none.
    """
    parts = {name: check_load(prepared, shape, name, given.get(name)) for name in LOADS}
    return make_loads(prepared, parts)


def check_load(
    prepared: PreparedBody, shape: tuple[int, ...], name: str, value: Tensor | None
) -> Tensor:
    """One of ``LOADS`` with the batch axes of positions (..., num_nodes, 3)."""
    return _CHECKS[name](prepared, shape, value)


def make_loads(prepared: PreparedBody, parts: Mapping[str, Tensor]) -> Loads:
    """All of ``LOADS``, checked, as one record."""
    return Loads(
        force=parts["external_force"],
        target=parts["dirichlet_target"],
        activation=parts["activation"],
        pressure=parts["pressure"],
        prepared=prepared,
    )


def _force(prepared: PreparedBody, shape: tuple[int, ...], value: Tensor | None) -> Tensor:
    """External forces and weight."""
    force, name = prepared.weight, "external_force"
    if value is not None:
        force = force + require(name, value, ("...", shape[-2], 3))
    return broadcast(name, force, shape)


def _target(prepared: PreparedBody, shape: tuple[int, ...], value: Tensor | None) -> Tensor:
    target, name = prepared.x_rest, "dirichlet_target"
    if value is not None:
        target = require(name, value, ("...", shape[-2], 3))
    return broadcast(name, target, shape)


def _activation(prepared: PreparedBody, shape: tuple[int, ...], value: Tensor | None) -> Tensor:
    rest = prepared.body.muscles.rest_activation
    return _signal("activation", value, "muscles", rest, shape[:-2])


def _pressure(prepared: PreparedBody, shape: tuple[int, ...], value: Tensor | None) -> Tensor:
    return _signal("pressure", value, "chambers", prepared.no_pressure, shape[:-2])


_CHECKS: dict[str, Callable[[PreparedBody, tuple[int, ...], Tensor | None], Tensor]] = {
    "external_force": _force,
    "dirichlet_target": _target,
    "activation": _activation,
    "pressure": _pressure,
}
LOADS = tuple(_CHECKS)


def _signal(
    name: str, value: Tensor | None, of: str, rest: Tensor, batch: tuple[int, ...]
) -> Tensor:
    """One number for each muscle or chamber, (..., size); ``rest`` (size,) where none is given."""
    if value is not None and not len(rest):
        raise ValueError(f"{name} was given, but the body has no {of}")
    value = rest if value is None else require(name, value, ("...", len(rest)))
    return broadcast(name, value, (*batch, len(rest)))


def energy_arrays(loads: Loads, frame: DampingFrame | None = None) -> EnergyArrays:
    """Parameters of the energy as the ops take them, batch axes flattened.

    Args:
        loads: Activations, pressures, body and physics.
        frame: Reference of damping; None: the energy without damping.
    """
    return EnergyArrays(**energy_terms(loads, frame))


def energy_terms(loads: Loads, frame: DampingFrame | None = None) -> dict[str, Tensor]:
    """Tensors of :func:`energy_arrays` by name."""
    prepared, muscles = loads.prepared, loads.prepared.body.muscles
    stiffness = prepared.fiber_stiffness
    if stiffness is None:
        physics = prepared.physics
        fibers = muscles.fibers(physics.fiber_stiffness, loads.activation, physics.fiber_weights)
        stiffness, stretch = prepared.of_members(fibers.stiffness), fibers.stretch
    else:
        stretch = muscles.stretch_of_fibers(loads.activation)
    return {
        "weights": prepared.weights,
        "fiber_stiffness": stiffness,
        "activation": flat(stretch, 1),
        "pressure": flat(loads.pressure, 1),
        "tables": prepared.tables,
        **_damping_terms(frame),
    }


def _damping_terms(frame: DampingFrame | None) -> dict[str, Tensor]:
    """Tensors of damping by name; empty where there is none."""
    if frame is None or frame.weights is None:
        return dict.fromkeys(("damp_mu", "damp_lambda", "x_frame", "x_velocity"), EMPTY)
    return {
        "damp_mu": frame.weights.mu,
        "damp_lambda": frame.weights.lame_lambda,
        "x_frame": flat(frame.x_frame),
        "x_velocity": flat(frame.x_velocity),
    }


def broadcast(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """``value`` expanded to ``shape``, or an error that names it."""
    if value.shape == shape:
        return value
    try:
        return value.expand(shape)
    except RuntimeError as err:
        raise ValueError(
            f"{name} must broadcast to {tuple(shape)}, got {tuple(value.shape)}; its leading axes "
            "must match the state's batch axes"
        ) from err


def flat(value: Tensor, trailing: int = 2) -> Tensor:
    """(batch, ...) with one leading axis, contiguous."""
    leading = value.ndim - trailing
    if leading == 1:
        return value.contiguous()
    if leading == 0:
        return value.contiguous().unsqueeze(0)
    batch = math.prod(value.shape[:leading])
    return value.reshape(batch, *value.shape[leading:]).contiguous()
