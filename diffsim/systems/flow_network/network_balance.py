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

import torch
from torch import Tensor

from diffsim.core.errors import ConvergenceError
from diffsim.systems.flow_network.network_conditions import NetworkConditions
from diffsim.systems.flow_network.soft_walls import invert_linearized, linearize_pressure
from diffsim.systems.flow_network.unit_flows import Shape

MAX_ITERS = 40


class Balance:
    """Mass and pressures of all levels; unknowns are flows over ``flow_scale`` and pump pressure.

    Args:
        scene: Conditions under which the flow is balanced.
    """

    def __init__(self, scene: NetworkConditions):
        self.scene, table = scene, scene.table
        self.device = table.device
        shape = Shape(scene.wall_offset, scene.slip_length, scene.narrowing)
        self.unit = table.at(shape)
        self.kernel = self._build_kernel()
        # what a pascal drives
        self.flow_scale = self.device.depth / float(self.unit.resistance.detach().mean())
        # plane flows [m^2/s] per scaled flow, and viscosity over the nominal one
        self.factor = self.flow_scale / self.device.depth * scene.viscosity / self.device.viscosity
        self.local = self._compute_local_factor()
        self.is_thinning = bool(scene.thinning.detach() != 0.0) or scene.thinning.requires_grad
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
        s, groups = self.scene, self.scene.table.groups
        height = groups.height / self.device.size[1] - 0.5
        return s.width_gain[groups.owner] ** -3 * (1.0 + s.viscosity_gradient * height)

    def _compute_energies(self, factor: Tensor) -> tuple[Tensor, Tensor]:
        """Resistance (levels, m, m) and that ahead of the tap (levels, m) of groups ``factor``
        (levels, groups) times as viscous; one everywhere gives the simulator's own."""
        m = len(self.unit.tap)
        both = factor @ self.kernel
        return both[:, : m * m].reshape(-1, m, m), both[:, m * m :]

    def at(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residual (levels, m + 1) [-, Pa], its slope, and the tap's pressure (levels,) [Pa]."""
        s, m = self.scene, y.shape[1] - 1
        flow, pump = y[:, :m], y[:, m]
        resistance, tap, extra = self._compute_resistance(flow)
        lost, lost_slope = self._compute_entrance_loss(flow)
        outlet = s.back_pressure + s.outlet_pressure + lost
        up, up_slope = linearize_pressure(pump, self.scene.compliance)
        down, down_slope = linearize_pressure(outlet, self.scene.compliance)
        drop = (resistance @ flow[..., None])[..., 0] * self.factor
        leak = s.leak / self.flow_scale
        mass = flow.sum(1) + leak * pump - s.drive[:, 0] / self.flow_scale
        residual = torch.cat([mass[:, None], up[:, None] - down - drop], 1)
        slope = y.new_zeros(len(y), m + 1, m + 1)
        slope[:, 0, :m], slope[:, 0, m] = 1.0, leak.detach()
        slope[:, 1:, m] = up_slope.detach()[:, None]
        slope[:, 1:, :m] = -((resistance + extra) * self.factor).detach()
        slope[:, 1:, :m] -= torch.diag_embed((down_slope * lost_slope).detach())
        at_tap = up - (tap * flow).sum(1) * self.factor
        return residual, slope, invert_linearized(at_tap, self.scene.compliance)

    def solved(self) -> Tensor:
        """The unknowns, (levels, m + 1), by Newton's method."""
        s = self.scene
        m = s.back_pressure.shape[1]
        y = torch.zeros(len(s.drive), m + 1, dtype=torch.float64)
        y[:, :m] = s.drive / (m * self.flow_scale)
        size = float("inf")
        for _ in range(MAX_ITERS):
            residual, slope, _ = self.at(y)
            given = s.drive.abs().max() / self.flow_scale + s.back_pressure.abs().max()
            size = float(residual.abs().max() / given.clamp(min=1e-12))  # flows and pressures alike
            if size <= s.rtol:
                return y
            y = y - torch.linalg.solve(slope, residual)
        raise ConvergenceError(
            f"flows and pressures of the network balance to {size:.1e} only after {MAX_ITERS} "
            f"steps, needed {s.rtol:.1e}; an effect is too large",
            residual_norm=size,
            tolerance=s.rtol,
            num_iters=MAX_ITERS,
        )

    def _compute_resistance(self, flow: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Resistance and tap, as ``_compute_energies``, and what the slope has besides."""
        s = self.scene
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
        thinned = self.local * (1.0 + squared) ** (-0.5 * s.thinning)
        energy, before = self._compute_energies(thinned)
        with torch.no_grad():
            # d R_ij q_j / d q_k: the factor's slope over rate^2, and of rate^2 over the flows
            slope = -s.thinning * thinned / (1.0 + squared)
            kernel = self.kernel[:, : m * m].reshape(-1, m, m)
            drops = torch.einsum("gij,lj->lgi", kernel, plane)
            extra = torch.einsum("lgi,lgk->lik", slope[..., None] * drops, along)
        return energy, before, extra

    def _compute_entrance_loss(self, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Entrance losses (levels, m) [Pa] and their slopes."""
        device, s = self.device, self.scene
        if not (s.entrance_loss.requires_grad or float(s.entrance_loss)):
            return torch.zeros_like(flow), torch.zeros_like(flow)
        gain = torch.stack([s.width_gain[k] for k in device.branches])
        width = torch.tensor([device.segments[k].width for k in device.branches]) * gain
        per = self.flow_scale / device.depth / (width + 2.0 * s.wall_offset)
        factor = 0.5 * device.density * s.entrance_loss * per**2
        return factor * flow * flow.abs(), 2.0 * factor * flow.abs()
