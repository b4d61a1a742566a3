"""A channel network as a model: unit flows of the Stokes simulator, driven, loaded and read.

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

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.data.study import Run
from diffsim.diagnose.beds.stokes.network import NetworkDevice
from diffsim.diagnose.beds.stokes.unit_flows import Shape, UnitFlows, UnitFlowTable
from diffsim.diagnose.model import Numerics, SimModel
from diffsim.errors import ConvergenceError
from diffsim.identify import Parameter

RTOL = 1e-10
MAX_ITERS = 40
_ZERO = torch.zeros((), dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class NetworkScene:
    """One run of the network with the hooks of its effects; at zero each is not there.

    Attributes:
        table: Unit flows of the device on its grid.
        drive: What the pump gives at each level, (num_levels, 1) [m^3/s].
        back_pressure: Commanded beyond each outlet, (num_levels, num_outlets) [Pa].
        level: Which level holds at each sample, (num_samples,).
        viscosity: [Pa s].
        width_gain: Of each channel's width, (num_segments,) [-]; small: by the cube law of slits.
        outlet_pressure: Beyond each outlet, on top of the commanded one, (num_outlets,) [Pa].
        channel_gain, channel_offset: Of every channel, (num_channels,): flows, then pressures.
        wall_offset: All walls outwards [m].
        slip_length: Navier [m].
        narrowing: Of the middle of each branch, relative to its width, (num_outlets,) [-].
        viscosity_gradient: Relative viscosity across the box in y, from -g/2 to g/2 [-].
        thinning: s of viscosity (1 + (rate / shear_rate)^2)^(-s / 2) [-].
        compliance: c of w (1 + c p) [1/Pa].
        entrance_loss: K of a loss K rho u^2 / 2 at each branch's entrance [-].
        leak: Flow lost at the pump over the pressure there [m^3/(s Pa)].
        columns: Channels that were measured, by index; all if None.
        rtol: Of the balance of pressures.
    """

    table: UnitFlowTable
    drive: Tensor
    back_pressure: Tensor
    level: Tensor
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

    def narrowed(self, outlet: int, size: Tensor) -> NetworkScene:
        """The middle of a branch narrower by ``size`` of its width."""
        one = torch.eye(len(self.narrowing), dtype=torch.float64)[outlet]
        return dataclasses.replace(self, narrowing=self.narrowing + size * one)

    def simulate(self) -> Tensor:
        """Flows and pressures, (num_samples, num_channels).

        Raises:
            ConvergenceError: flows and pressures do not balance; an effect is too large.
        """
        balance = _Balance(self)
        with torch.no_grad():
            y = balance.solved()
        residual, slope, tap = balance.at(y)
        # one Newton step more carries the gradients of the balance (implicit function theorem)
        y = y - torch.linalg.solve(slope.detach(), residual)
        if residual.requires_grad:
            tap = balance.at(y)[2]
        levels = torch.cat([y[:, :-1] * balance.flow_scale, y[:, -1:], tap[:, None]], 1)
        shown = levels * self.channel_gain + self.channel_offset
        if self.columns is not None:
            shown = shown[:, list(self.columns)]
        return shown[self.level]


class _Balance:
    """Mass and pressures of all levels; unknowns are flows over ``flow_scale`` and pump pressure.

    Args:
        scene: Whose effects hold.
    """

    def __init__(self, scene: NetworkScene):
        self.scene, table = scene, scene.table
        self.device = table.device
        shape = Shape(scene.wall_offset, scene.slip_length, scene.narrowing)
        self.unit = table.at(shape)
        self.kernel = self._kernel()
        # what a pascal drives
        self.flow_scale = self.device.depth / float(self.unit.resistance.detach().mean())
        # plane flows [m^2/s] per scaled flow, and viscosity over the nominal one
        self.factor = self.flow_scale / self.device.depth * scene.viscosity / self.device.viscosity
        self.local = self._local_factor()
        self.is_thinning = bool(scene.thinning.detach() != 0.0) or scene.thinning.requires_grad
        if not self.is_thinning:
            energy, before = self._energies(self.local[None])
            self.resistance, self.tap = energy, before

    def _kernel(self) -> Tensor:
        """What every group of cells adds to the resistance and, in the last columns, to that ahead
        of the tap, (groups, m^2 + m): its dissipation, scaled so that the sums are the unit
        flows' own."""
        unit, groups = self.unit, self.scene.table.groups
        inside = unit.energy * groups.after_pump[:, None, None]
        before = (unit.energy * groups.before_tap[:, None, None]).mean(1)
        resistance = inside * (unit.resistance / inside.sum(0))
        return torch.cat([resistance.flatten(1), before * (unit.tap / before.sum(0))], 1)

    def _local_factor(self) -> Tensor:
        """Resistance of the groups by width and temperature over the nominal one, (groups,)."""
        s, groups = self.scene, self.scene.table.groups
        height = groups.height / self.device.size[1] - 0.5
        return s.width_gain[groups.owner] ** -3 * (1.0 + s.viscosity_gradient * height)

    def _energies(self, factor: Tensor) -> tuple[Tensor, Tensor]:
        """Resistance (levels, m, m) and that ahead of the tap (levels, m) of groups ``factor``
        (levels, groups) times as viscous; one everywhere gives the simulator's own."""
        m = len(self.unit.tap)
        both = factor @ self.kernel
        return both[:, : m * m].reshape(-1, m, m), both[:, m * m :]

    def at(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Residual (levels, m + 1) [-, Pa], its slope, and the tap's pressure (levels,) [Pa]."""
        s, m = self.scene, y.shape[1] - 1
        flow, pump = y[:, :m], y[:, m]
        resistance, tap, extra = self._resistance(flow)
        lost, lost_slope = self._loss(flow)
        outlet = s.back_pressure + s.outlet_pressure + lost
        up, up_slope = self._widened(pump)
        down, down_slope = self._widened(outlet)
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
        return residual, slope, self._narrowed(at_tap)

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

    def _resistance(self, flow: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Resistance and tap, as ``_energies``, and what the slope has more than the resistance."""
        s = self.scene
        if not self.is_thinning:
            return self.resistance, self.tap, torch.zeros((), dtype=torch.float64)
        unit, m = self.unit, flow.shape[1]
        plane = flow * (self.flow_scale / self.device.depth)
        form = unit.energy / unit.volume.clamp(min=1e-300)[:, None, None]
        form = form / self.device.shear_rate**2
        along = torch.einsum("gij,lj->lgi", form, plane)
        squared = (along * plane[:, None]).sum(-1)
        thinned = self.local * (1.0 + squared) ** (-0.5 * s.thinning)
        energy, before = self._energies(thinned)
        with torch.no_grad():
            # d R_ij q_j / d q_k: the factor's slope over rate^2, and of rate^2 over the flows
            slope = -s.thinning * thinned / (1.0 + squared)
            kernel = self.kernel[:, : m * m].reshape(-1, m, m)
            drops = torch.einsum("gij,lj->lgi", kernel, plane)
            extra = torch.einsum("lgi,lgk->lik", slope[..., None] * drops, along)
        return energy, before, extra

    def _loss(self, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Entrance losses (levels, m) [Pa] and their slopes."""
        device, s = self.device, self.scene
        if not (s.entrance_loss.requires_grad or float(s.entrance_loss)):
            return torch.zeros_like(flow), torch.zeros_like(flow)
        gain = torch.stack([s.width_gain[k] for k in device.branches])
        width = torch.tensor([device.segments[k].width for k in device.branches]) * gain
        per = self.flow_scale / device.depth / (width + 2.0 * s.wall_offset)
        factor = 0.5 * device.density * s.entrance_loss * per**2
        return factor * flow * flow.abs(), 2.0 * factor * flow.abs()

    def _widened(self, pressure: Tensor) -> tuple[Tensor, Tensor]:
        """F(p) and its slope."""
        c = self.scene.compliance
        x = c * pressure
        # ((1 + x)^4 - 1) / 4 c, without a division by c
        return pressure * (1.0 + x * (1.5 + x * (1.0 + 0.25 * x))), (1.0 + x) ** 3

    def _narrowed(self, value: Tensor) -> Tensor:
        """p of F(p)."""
        c = self.scene.compliance
        x = 4.0 * c * value
        # ((1 + x)^(1/4) - 1) / c, without a division by c
        root = (1.0 + x) ** 0.25
        return 4.0 * value / ((root + 1.0) * (root**2 + 1.0))


def network_base(device: NetworkDevice, runs: Sequence[str]) -> tuple[Parameter, ...]:
    """What is always imperfectly known of a network.

    Viscosity to 1 %, widths to 0.3 %, what the pump gives in each run to 0.5 %, each meter to
    0.5 %, the zeros of the pressure sensors to 0.2 Pa.
    """
    return (
        Parameter("viscosity", device.viscosity, 0.01, "Pa s", log=True),
        *(Parameter(f"width_{s.name}", s.width, 0.003, "m", log=True) for s in device.segments),
        *(Parameter(f"flow_gain_{i + 1}", 1.0, 0.005) for i in range(len(device.outlets))),
        *(Parameter(f"pressure_zero_{i + 1}", 0.0, 0.2, "Pa") for i in range(2)),
        *(Parameter(f"pump_gain@{run}", 1.0, 0.005) for run in runs),
    )


def network_model(
    device: NetworkDevice,
    base: Sequence[Parameter],
    *,
    pump: str,
    back_pressures: Sequence[str],
    columns: Sequence[int] | None = None,
) -> SimModel:
    """A network as a model for the diagnosis: channels are outlet flows, pump and tap pressure.

    Args:
        device: The network.
        base: Of the names that ``network_base`` uses; those left out hold their nominal value.
        pump: Name of the command of the pump [m^3/s].
        back_pressures: Names of the commands of pressures beyond the outlets [Pa]. Those that a
            run does not have are zero.
        columns: Which of the channels are measured, by index; all if None.

    Returns:
        Model. Unit flows are simulated when first needed and kept with the model;
        ``Numerics.mesh`` scales the cells, ``tolerance`` the balance; ``time_step`` has no meaning.
    """
    nominal = {p.name: p.value for p in network_base(device, ())}
    unknown = sorted(
        p.name for p in base if p.name not in nominal and not p.name.startswith("pump_gain@")
    )
    if unknown:
        raise ValueError(f"base parameters {unknown} are unknown; known are {sorted(nominal)}")
    num_flows = len(device.outlets)

    @lru_cache(maxsize=4)
    def table(mesh: float) -> UnitFlowTable:
        return UnitFlowTable(device, mesh)

    def build(values: Mapping[str, Tensor], run: Run, numerics: Numerics) -> NetworkScene:
        fixed = {k: torch.tensor(v, dtype=torch.float64) for k, v in nominal.items()}
        v = fixed | dict(values)
        one = torch.ones((), dtype=torch.float64)
        gains = [v[f"width_{s.name}"] / s.width for s in device.segments]
        drive, back, level = _levels(run, pump, back_pressures)
        zeros = torch.zeros(num_flows, dtype=torch.float64)
        return NetworkScene(
            table=table(numerics.mesh),
            drive=drive * v.get(f"pump_gain@{run.name}", one),
            back_pressure=back,
            level=level,
            viscosity=v["viscosity"],
            width_gain=torch.stack(gains),
            outlet_pressure=zeros,
            channel_gain=torch.stack(
                [*(v[f"flow_gain_{i + 1}"] for i in range(num_flows)), one, one]
            ),
            channel_offset=torch.cat(
                [zeros, torch.stack([v["pressure_zero_1"], v["pressure_zero_2"]])]
            ),
            narrowing=zeros,
            columns=None if columns is None else tuple(columns),
            rtol=RTOL * numerics.tolerance,
        )

    make: Any = build
    return SimModel(make, base, name="channel network")


def _levels(run: Run, pump: str, back: Sequence[str]) -> tuple[Tensor, Tensor, Tensor]:
    """Different levels of the pump (levels, 1) and of the back pressures (levels, m), and which of
    them holds at each sample."""
    if pump not in run.command:
        raise ValueError(f"run {run.name}: command {pump} is missing, got {sorted(run.command)}")
    none = np.zeros(len(run.time_s))
    commands = np.stack([np.asarray(run.command.get(name, none)) for name in (pump, *back)], -1)
    levels, level = np.unique(commands, axis=0, return_inverse=True)
    rows = torch.from_numpy(levels)
    return rows[:, :1], rows[:, 1:], torch.from_numpy(level.reshape(-1))
