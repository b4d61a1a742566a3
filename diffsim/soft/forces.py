"""Elastic, muscle, pressure and damping forces, and their energy."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import all_finite, require
from diffsim.core.checked import checked
from diffsim.core.layer import is_kernel_alone
from diffsim.soft import _ops_elastic
from diffsim.soft.inputs import DampingFrame, Loads, check_inputs, energy_arrays, flat
from diffsim.soft.physics import Physics
from diffsim.soft.prepared import prepare
from diffsim.soft.solid import Solid
from diffsim.soft.state import State


def elastic_gradient(
    x: Tensor, loads: Loads, frame: DampingFrame | None = None
) -> tuple[Tensor, Tensor]:
    """Gradient of the energy, with damping where a frame is given [N], and the energy [J].

    The arguments are checked already. With damping there is no energy.
    """
    arrays, body = energy_arrays(loads, frame), loads.prepared.body
    gradient, energy = _ops_elastic.elastic_gradient(
        flat(x),
        *arrays.tensors(),
        handle=body.handle,
        num_threads=body.solver.num_threads,
    )
    return gradient.reshape(x.shape), energy.reshape(x.shape[:-2])


class ElasticGradient:
    """The gradient of one energy, asked for at many places of one shape.

    Args:
        loads: Activations, pressures, body and physics, of that shape.

    Attributes:
        loads: Loads as they were given.
    """

    def __init__(self, loads: Loads):
        self.loads = loads
        self._arrays = energy_arrays(loads)
        self._tensors = self._arrays.tensors()
        self._bound: _ops_elastic.BoundGradient | None = None

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """As :func:`elastic_gradient`; x (..., num_nodes, 3) [m] is checked here."""
        body = self.loads.prepared.body
        if not is_kernel_alone((x, *self._tensors)):
            x = require("x", x, ("...", body.mesh.num_nodes, 3))
            return elastic_gradient(x, self.loads)
        places = flat(x)
        if self._bound is None:
            options = {"handle": body.handle, "num_threads": body.solver.num_threads}
            self._bound = _ops_elastic.BoundGradient(self._arrays, batch=len(places), **options)
        gradient, energy = self._bound(places)
        if not all_finite(energy):  # an energy is finite nowhere that a place is not
            require("x", x, x.shape)
        return gradient.reshape(x.shape), energy.reshape(x.shape[:-2])


@checked
def elastic_force(
    body: Solid,
    x: Tensor,
    *,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Elastic, muscle and pressure force -d(E - p V)/dx (thesis eq. 4.16).

    Args:
        body: The body.
        x: Positions, (..., num_nodes, 3) [m].
        activation: Muscle activations, broadcastable to (..., num_muscles); None: rest.
        pressure: Gauge pressures of the chambers, broadcastable to (..., num_chambers) [Pa];
            None: zero.
        physics: Parameters; None: the body's own.

    Returns:
        Forces, shape of x [N]. Gradients: x, activation, pressure, physics; first order.
    """
    x, loads = _check_state(body, x, activation=activation, pressure=pressure, physics=physics)
    return -elastic_gradient(x, loads)[0]


@checked
def elastic_energy(
    body: Solid,
    x: Tensor,
    *,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Elastic and muscle energy, less the work p V of the chambers' pressures.

    Args:
        body: The body.
        x: Positions, (..., num_nodes, 3) [m].
        activation: Muscle activations, broadcastable to (..., num_muscles); None: rest.
        pressure: Gauge pressures of the chambers, broadcastable to (..., num_chambers) [Pa];
            None: zero.
        physics: Parameters; None: the body's own.

    Returns:
        Energies, (...) [J]. Gradients: x, activation, pressure, physics; first order.
    """
    x, loads = _check_state(body, x, activation=activation, pressure=pressure, physics=physics)
    energy, _ = _ops_elastic.elastic_energy(
        flat(x),
        *energy_arrays(loads).tensors(),
        handle=body.handle,
        num_threads=body.solver.num_threads,
    )
    return energy.reshape(x.shape[:-2])


def _check_state(
    body: Solid,
    x: Tensor,
    *,
    activation: Tensor | None,
    pressure: Tensor | None,
    physics: Physics | None,
) -> tuple[Tensor, Loads]:
    x = require("x", x, ("...", body.mesh.num_nodes, 3))
    state = State(x, torch.zeros_like(x))
    prepared = prepare(body, physics)
    return check_inputs(prepared, state, activation=activation, pressure=pressure)
