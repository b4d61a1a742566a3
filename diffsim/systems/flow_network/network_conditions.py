"""The conditions of a channel network in one run, with the hooks of its effects."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.systems.flow_network.steady import SteadyScene
from diffsim.systems.flow_network.unit_flows import UnitFlowTable

RTOL = 1e-10
_ZERO = torch.zeros((), dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkConditions(SteadyScene):
    """Drive, walls and fluid of one run; an effect whose number is zero is absent.

    Attributes:
        table: Unit flows of the device on its grid.
        viscosity: Viscosity of the fluid at no shear [Pa s].
        width_gain: Relative change of each channel's width, (num_segments,) [-]; small, applied by
            the cube law of slits.
        outlet_pressure: Beyond each outlet, on top of the commanded one, (num_outlets,) [Pa].
        channel_gain, channel_offset: Gain [-] and offset [unit of the channel] of every meter,
            (num_channels,): flows, then pressures.
        wall_offset: Distance by which all walls move outwards [m].
        slip_length: Slip length of Navier's condition at the walls [m].
        narrowing: Narrowing of the middle of each branch, relative to its width, (num_outlets,)
            [-].
        viscosity_gradient: Relative viscosity across the box in y, from -g/2 to g/2 [-].
        thinning: s of viscosity (1 + (rate / shear_rate)^2)^(-s / 2) [-].
        compliance: Compliance c of the walls: the width at pressure p is w (1 + c p) [1/Pa].
        entrance_loss: K of a loss K rho u^2 / 2 at each branch's entrance [-].
        leak: Flow lost at the pump over the pressure there [m^3/(s Pa)].
        columns: Channels that were measured, by index; all if None.
        rtol: Relative tolerance of the balance of mass and pressures [-].
    """

    table: UnitFlowTable
    viscosity: Tensor
    width_gain: Tensor
    outlet_pressure: Tensor
    channel_gain: Tensor
    channel_offset: Tensor
    narrowing: Tensor
    wall_offset: Tensor = _ZERO
    slip_length: Tensor = _ZERO
    viscosity_gradient: Tensor = _ZERO
    thinning: Tensor = _ZERO
    compliance: Tensor = _ZERO
    entrance_loss: Tensor = _ZERO
    leak: Tensor = _ZERO
    columns: tuple[int, ...] | None = None
    rtol: float = RTOL
