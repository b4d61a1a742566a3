"""Elastic, muscle, pressure and damping forces, and their energy."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from diffsim.core.check import require
from diffsim.soft import _ops_elastic
from diffsim.soft.inputs import EMPTY, check_inputs, flat
from diffsim.soft.physics import Physics
from diffsim.soft.state import State

if TYPE_CHECKING:
    from diffsim.soft.body import SoftBody


def elastic_gradient(
    body: SoftBody,
    x: Tensor,
    v: Tensor | None,
    activation: Tensor,
    pressure: Tensor,
    physics: Physics,
) -> tuple[Tensor, Tensor]:
    """Gradient of the energy, with damping where v is given [N], and the energy [J].

    The arguments are checked already; the energy's gradient is right in x alone.
    """
    stiffness, stretch = body.muscles.fibres(physics.fibre_stiffness, activation)
    damp_mu, damp_lambda, frame, x_velocity = EMPTY, EMPTY, EMPTY, EMPTY
    if v is not None and physics.rayleigh_beta is not None:
        damp_mu, damp_lambda = physics.damping(1.0)
        frame, x_velocity = flat(x), flat(x - v)
    gradient, energy = _ops_elastic.elastic_gradient(
        flat(x),
        [
            physics.w_mu,
            physics.w_vol,
            stiffness.contiguous(),
            flat(stretch, 1),
            damp_mu.contiguous(),
            damp_lambda.contiguous(),
            frame,
            x_velocity,
            flat(pressure, 1),
        ],
        body.handle,
        body.solver.num_threads,
    )
    return gradient.reshape(x.shape), energy.reshape(x.shape[:-2])


def elastic_force(
    body: SoftBody,
    x: Tensor,
    *,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Elastic, muscle and pressure force -d(E - p V)/dx (thesis eq. 4.16).

    Args:
        body: The body.
        x: Positions, (..., num_vertices, 3) [m].
        activation: Muscle activations, broadcastable to (..., num_muscles); None: rest.
        pressure: Gauge pressures of the chambers, broadcastable to (..., num_chambers) [Pa];
            None: zero.
        physics: Parameters; None: the body's own.

    Returns:
        Forces, shape of x [N]. Gradients: x, activation, pressure, physics; first order.
    """
    return -elastic_gradient(body, *_checked(body, x, activation, pressure, physics))[0]


def elastic_energy(
    body: SoftBody,
    x: Tensor,
    *,
    activation: Tensor | None = None,
    pressure: Tensor | None = None,
    physics: Physics | None = None,
) -> Tensor:
    """Elastic and muscle energy, less the work p V of the chambers' pressures.

    Args:
        As in :func:`elastic_force`.

    Returns:
        Energies, (...) [J]. Gradient: x only (parameters are treated as constants).
    """
    x, v, activation, pressure, physics = _checked(body, x, activation, pressure, physics)
    constants = replace(
        physics,
        w_mu=physics.w_mu.detach(),
        w_vol=physics.w_vol.detach(),
        fibre_stiffness=physics.fibre_stiffness.detach(),
    )
    return elastic_gradient(body, x, v, activation.detach(), pressure.detach(), constants)[1]


def _checked(
    body: SoftBody,
    x: Tensor,
    activation: Tensor | None,
    pressure: Tensor | None,
    physics: Physics | None,
) -> tuple[Tensor, None, Tensor, Tensor, Physics]:
    physics = body.physics() if physics is None else physics
    x = require("x", x, ("...", body.mesh.num_vertices, 3))
    state = State(x, torch.zeros_like(x))
    x, _, _, activation, pressure = check_inputs(
        body, state, None, activation, pressure, None, physics
    )
    return x, None, activation, pressure, physics
