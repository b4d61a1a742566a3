"""Flows and pressures of a channel network at some levels of its drive.

Unknowns of a level are the flows q to the outlets and the pressure P at the pump:

    sum q = pump - leak P
    F(P) - F(p_out,i + loss_i) = sum_j R_ij(q) q_j        for every outlet i

R is the Stokes simulator's resistance (``UnitFlows``). A viscosity that differs from place to place
enters as the dissipation that it adds to the unit flows (a Ritz approximation: the resistance's
error is of second order in the profile's change; 0.1 % of it for a power law of exponent 0.9). F(p)
= ((1 + c p)^4 - 1) / (4 c) makes channels of width w (1 + c p) linear, as their flow goes as
(1 + c p)^3 dp / dx where the width changes slowly along the channel; F(p) = p where c = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.systems.flow_network.steady import (
    SteadyScene,
    balanced,
    invert_linearized,
    linearize_pressure,
)
from diffsim.systems.flow_network.unit_flows import ChannelShape, UnitFlowTable

RTOL = 1e-10


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkScene(SteadyScene):
    """One run of the network; flows are measured at its outlets, pressures at pump and tap.

    Numbers: ``viscosity`` at no shear [Pa s]; ``width_NAME`` of each channel [m], whose small
    changes act by the cube law of slits; ``wall_offset`` and ``slip_length`` [m];
    ``viscosity_gradient``, relative, across the box in y; ``thinning``, s of viscosity
    (1 + (rate / shear_rate)^2)^(-s / 2); ``compliance``, c of width w (1 + c p) [1/Pa];
    ``entrance_loss``, K of a loss K rho u^2 / 2 at each branch's entrance; ``leak``, flow lost at
    the pump over the pressure there [m^3/(s Pa)]; of each outlet ``narrowing_1`` of its branch's
    middle, relative to its width, and ``outlet_pressure_1`` on top of the commanded one [Pa]; of
    each meter ``meter_1``, its gain; ``pressure_zero_1`` and ``pressure_zero_2`` [Pa].
    """

    table: UnitFlowTable  # unit flows of the device on its grid
    columns: tuple[int, ...]  # channels that were measured, by index

    def simulate(self) -> Tensor:
        """Flows and pressures, (num_samples, num_channels).

        Raises:
            ConvergenceError: flows and pressures do not balance; an effect is too large.
        """
        drive, held, level = self.levels()
        balance = Balance(self, drive, held)
        y = balance.solved()
        tap = balance.at(y)[2]
        levels = torch.cat([y[:, :-1] * balance.flow_scale, y[:, -1:], tap[:, None]], 1)
        flows = levels.shape[1] - 2
        none = torch.zeros(flows, dtype=torch.float64)
        zeros = torch.cat([none, self.several("pressure_zero", 2)])
        shown = levels * self.several("meter", flows + 2) + zeros
        return self.instruments.read_late(shown[:, list(self.columns)][level], self.grid)


class Balance:
    """Mass and pressures of all levels; unknowns are flows over ``flow_scale`` and pump pressure.

    Args:
        scene: Conditions under which the flow is balanced.
        drive: What the pump gives at each level, (levels, 1) [m^3/s].
        held: Commanded pressures beyond the outlets, (levels, m) [Pa].
    """

    def __init__(self, scene: NetworkScene, drive: Tensor, held: Tensor):
        self.scene, self.drive, self.held, table = scene, drive, held, scene.table
        self.device = table.device
        outlets = len(self.device.outlets)
        self.outlet_pressure = scene.several("outlet_pressure", outlets)
        self.compliance, self.thinning = scene.number("compliance"), scene.number("thinning")
        widths = [scene.number(f"width_{s.name}") / s.width for s in self.device.segments]
        self.width_gain = torch.stack(widths)
        narrowing = scene.several("narrowing", outlets)
        self.unit = table.at(
            ChannelShape(scene.number("wall_offset"), scene.number("slip_length"), narrowing)
        )
        self.kernel = self._build_kernel()
        # what a pascal drives
        self.flow_scale = self.device.depth / float(self.unit.resistance.detach().mean())
        # plane flows [m^2/s] per scaled flow, and viscosity over the nominal one
        viscosity = scene.number("viscosity")
        self.factor = self.flow_scale / self.device.depth * viscosity / self.device.viscosity
        self.local = self._compute_local_factor()
        self.is_thinning = bool(self.thinning.detach() != 0.0) or self.thinning.requires_grad
        if not self.is_thinning:
            energy, before = self._compute_energies(self.local[None])
            self.resistance, self.tap = energy, before

    def _build_kernel(self) -> Tensor:
        """What every group of cells adds to the resistance and, in the last columns, to that ahead
        of the tap, (groups, m^2 + m): its dissipation, scaled so that the sums are the unit
        flows' own."""
        unit, groups = self.unit, self.scene.table.groups
        inside = unit.energy * groups.after_pump[:, None, None]
        before = (unit.energy * groups.before_tap[:, None, None]).mean(1)
        resistance = inside * (unit.resistance / inside.sum(0))
        return torch.cat([resistance.flatten(1), before * (unit.tap / before.sum(0))], 1)

    def _compute_local_factor(self) -> Tensor:
        """Resistance of the groups by width and temperature over the nominal one, (groups,)."""
        groups, gradient = self.scene.table.groups, self.scene.number("viscosity_gradient")
        height = groups.height / self.device.size[1] - 0.5
        return self.width_gain[groups.owner] ** -3 * (1.0 + gradient * height)

    def _compute_energies(self, factor: Tensor) -> tuple[Tensor, Tensor]:
        """Resistance (levels, m, m) and that ahead of the tap (levels, m) of groups ``factor``
        (levels, groups) times as viscous; one everywhere gives the simulator's own."""
        m = len(self.unit.tap)
        both = factor @ self.kernel
        return both[:, : m * m].reshape(-1, m, m), both[:, m * m :]

    def at(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residual (levels, m + 1) [-, Pa], its slope, and the tap's pressure (levels,) [Pa]."""
        m = y.shape[1] - 1
        flow, pump = y[:, :m], y[:, m]
        resistance, tap, extra = self._compute_resistance(flow)
        lost, lost_slope = self._compute_entrance_loss(flow)
        outlet = self.held + self.outlet_pressure + lost
        up, up_slope = linearize_pressure(pump, self.compliance)
        down, down_slope = linearize_pressure(outlet, self.compliance)
        drop = (resistance @ flow[..., None])[..., 0] * self.factor
        leak = self.scene.number("leak") / self.flow_scale
        mass = flow.sum(1) + leak * pump - self.drive[:, 0] / self.flow_scale
        residual = torch.cat([mass[:, None], up[:, None] - down - drop], 1)
        slope = y.new_zeros(len(y), m + 1, m + 1)
        slope[:, 0, :m], slope[:, 0, m] = 1.0, leak.detach()
        slope[:, 1:, m] = up_slope.detach()[:, None]
        slope[:, 1:, :m] = -((resistance + extra) * self.factor).detach()
        slope[:, 1:, :m] -= torch.diag_embed((down_slope * lost_slope).detach())
        at_tap = up - (tap * flow).sum(1) * self.factor
        return residual, slope, invert_linearized(at_tap, self.compliance)

    def solved(self) -> Tensor:
        """The unknowns, (levels, m + 1)."""
        m = self.held.shape[1]
        start = torch.zeros(len(self.drive), m + 1, dtype=torch.float64)
        start[:, :m] = self.drive.detach() / (m * self.flow_scale)
        given = self.drive.abs().max() / self.flow_scale + self.held.abs().max()
        # flows and pressures alike
        tolerance = self.scene.rtol * float(given.detach().clamp(min=1e-12))
        return balanced(lambda y: self.at(y)[:2], start, tolerance)

    def _compute_resistance(self, flow: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Resistance and tap, as ``_compute_energies``, and what the slope has besides."""
        if not self.is_thinning:
            return self.resistance, self.tap, torch.zeros((), dtype=torch.float64)
        unit, m = self.unit, flow.shape[1]
        plane = flow * (self.flow_scale / self.device.depth)
        # groups beyond the nominal wall may be interpolated to a trace of fluid, or less
        trace = 1e-6 * unit.volume.detach().max()
        form = unit.energy / unit.volume.clamp(min=trace)[:, None, None]
        form = form / self.device.shear_rate**2
        along = torch.einsum("gij,lj->lgi", form, plane)
        squared = (along * plane[:, None]).sum(-1).clamp(min=0.0)
        thinned = self.local * (1.0 + squared) ** (-0.5 * self.thinning)
        energy, before = self._compute_energies(thinned)
        with torch.no_grad():
            # d R_ij q_j / d q_k: the factor's slope over rate^2, and of rate^2 over the flows
            slope = -self.thinning * thinned / (1.0 + squared)
            kernel = self.kernel[:, : m * m].reshape(-1, m, m)
            drops = torch.einsum("gij,lj->lgi", kernel, plane)
            extra = torch.einsum("lgi,lgk->lik", slope[..., None] * drops, along)
        return energy, before, extra

    def _compute_entrance_loss(self, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Entrance losses (levels, m) [Pa] and their slopes."""
        device, loss = self.device, self.scene.number("entrance_loss")
        if not (loss.requires_grad or float(loss)):
            return torch.zeros_like(flow), torch.zeros_like(flow)
        gain = torch.stack([self.width_gain[k] for k in device.branches])
        width = torch.tensor([device.segments[k].width for k in device.branches]) * gain
        per = self.flow_scale / device.depth / (width + 2.0 * self.scene.number("wall_offset"))
        factor = 0.5 * device.density * loss * per**2
        return factor * flow * flow.abs(), 2.0 * factor * flow.abs()
