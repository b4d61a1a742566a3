"""A network of narrow channels by the resistance of each: lubrication theory, no grid.

Unknowns of a level of the drive are the pressures p of the free nodes and the flows q:

    sum of q into a node + what a pump gives - leak p = 0      for every free node, each its leak
    F(p_start) - F(p_end) = r(q) + K rho u |u| / 2             for every channel

F(p) = ((1 + c p)^4 - 1) / (4 c) makes channels of width w (1 + c p) linear; F(p) = p where c = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffsim.core.errors import ConvergenceError
from diffsim.systems.flow_network.soft_walls import invert_linearized, linearize_pressure
from diffsim.systems.flow_network.steady import SteadyScene

RTOL, MAX_ITERS = 1e-11, 60
THROAT = 0.5  # share of a channel's length over which something may lodge in it, a raised cosine
_ZERO = torch.zeros((), dtype=torch.float64)
_X, _W = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(8))
_PLACES, _SHARES = 0.5 * (_X + 1.0), 0.5 * _W  # Gauss points of (0, 1)


@dataclass(frozen=True)
class Reading:
    """What a meter reads: the flow in a channel, or the pressure at a place.

    Attributes:
        tube: Index of the channel whose flow, or inside which the pressure, is read; -1: none.
        node: Index of the node whose pressure is read; -1: none.
        share: Place in the channel, from its start; None: its flow is read.
    """

    tube: int = -1
    node: int = -1
    share: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Which channels join which nodes.

    Attributes:
        starts, ends: Index of the node at either end of each channel.
        shapes: "slit", "rectangle", "round" or "resistance", one per channel.
        free: Nodes whose pressure is unknown.
        pumps: Node of each pump.
        held: Node of each pressure source.
        branches: Channels that end at a pressure source: what leaves the network.
        readings: Of the study's channels, in order.
    """

    starts: tuple[int, ...]
    ends: tuple[int, ...]
    shapes: tuple[str, ...]
    free: tuple[int, ...]
    pumps: tuple[int, ...]
    held: tuple[int, ...]
    branches: tuple[int, ...]
    readings: tuple[Reading, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedScene(SteadyScene):
    """One run of the network; an effect whose number is zero is absent.

    Attributes:
        layout: What joins what.
        viscosity: Viscosity of the fluid at no shear [Pa s].
        width, height, length: Of each channel, (num_tubes,) [m]; a round one has its diameter as
            width, one of known resistance that [Pa s/m^3] at ``nominal_viscosity``.
        nominal_viscosity: At which resistances are known [Pa s].
        outlet_pressure: On top of ``back_pressure``, (num_held,) [Pa].
        channel_gain, channel_offset: Of every meter, (num_channels,).
        narrowing: Of the middle of each branch, relative to its width, (num_branches,) [-].
        density: Of the fluid [kg/m^3].
        shear_rate: Beyond which the fluid thins [1/s].
        wall_offset, slip_length: Walls further out, and slip at them [m].
        thinning: s of viscosity (1 + (rate / shear_rate)^2)^(-s / 2) [-].
        compliance: c of width w (1 + c p) [1/Pa].
        entrance_loss: K of a loss K rho u^2 / 2 in each branch [-].
        leak: Flow lost at each pump over the pressure there [m^3/(s Pa)].
        node_leak: The same at each free node, (num_free,) [m^3/(s Pa)].
        rtol: Relative tolerance of the balance [-].
    """

    layout: Layout
    viscosity: Tensor
    width: Tensor
    height: Tensor
    length: Tensor
    nominal_viscosity: float
    outlet_pressure: Tensor
    channel_gain: Tensor
    channel_offset: Tensor
    narrowing: Tensor
    density: float
    shear_rate: float
    wall_offset: Tensor = _ZERO
    slip_length: Tensor = _ZERO
    thinning: Tensor = _ZERO
    compliance: Tensor = _ZERO
    entrance_loss: Tensor = _ZERO
    leak: Tensor = _ZERO
    node_leak: Tensor = _ZERO
    rtol: float = RTOL

    def simulate(self) -> Tensor:
        """Readings, (num_samples, num_channels).

        Raises:
            ConvergenceError: flows and pressures do not balance; an effect is too large.
        """
        balance = _Balance(self)
        with torch.no_grad():
            y = balance.solved()
        residual, slope = balance.at(y)
        # one Newton step more carries the gradients (implicit function theorem)
        y = y - torch.linalg.solve(slope.detach(), residual)
        return self.show(balance.read(y) * self.channel_gain + self.channel_offset)


class _Balance:
    """Mass and pressures of all levels; unknowns are free pressures [Pa] and flows over a scale."""

    def __init__(self, scene: LumpedScene):
        self.scene, layout = scene, scene.layout
        self.resistance, self.rate = self._compute_tubes()
        nodes = 1 + max(*layout.starts, *layout.ends)
        incidence = torch.zeros(nodes, len(layout.starts), dtype=torch.float64)
        for k, (a, b) in enumerate(zip(layout.starts, layout.ends, strict=True)):
            incidence[a, k] -= 1.0
            incidence[b, k] += 1.0
        self.incidence = incidence
        pumped = float(scene.drive.detach().abs().max()) if scene.drive.numel() else 0.0
        pushed = float((scene.back_pressure + scene.outlet_pressure).detach().abs().max())
        mean = float(self.resistance.detach().mean())
        self.flow_scale = max(pumped, pushed / mean, 1e-6 / mean)
        self.pressure_scale = self.flow_scale * mean

    def solved(self) -> Tensor:
        """The unknowns, (levels, num_free + num_tubes), by Newton's method."""
        levels, n = len(self.scene.level), len(self.scene.layout.free)
        levels = len(self.scene.back_pressure)
        y = torch.zeros(levels, n + len(self.scene.layout.starts), dtype=torch.float64)
        size = float("inf")
        for _ in range(MAX_ITERS):
            residual, slope = self.at(y)
            size = float(residual.abs().max())
            if size <= self.scene.rtol:
                return y
            y = y - torch.linalg.solve(slope, residual)
        raise ConvergenceError(
            f"flows and pressures of the network balance to {size:.1e} only after {MAX_ITERS} "
            f"steps, needed {self.scene.rtol:.1e}; an effect is too large",
            residual_norm=size,
            tolerance=self.scene.rtol,
            num_iters=MAX_ITERS,
        )

    def at(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Residual (levels, unknowns) over its scales [-], and its slope."""
        s, layout = self.scene, self.scene.layout
        n = len(layout.free)
        pressure, flow = self._join_pressures(y), y[:, n:] * self.flow_scale
        free = list(layout.free)
        pumps = torch.zeros(len(self.incidence), dtype=torch.float64)
        given = torch.zeros(len(y), len(pumps), dtype=torch.float64)
        for k, node in enumerate(layout.pumps):
            pumps[node] += 1.0
            given = given + s.drive[:, k, None] * _make_unit_row(len(pumps), node)
        leaky = s.leak * pumps[free] + s.node_leak
        mass = (flow @ self.incidence.mT + given)[:, free] - leaky * pressure[:, free]
        widened, steep = linearize_pressure(pressure, self.scene.compliance)
        used, rise = self._compute_drop(flow)
        drop = widened[:, list(layout.starts)] - widened[:, list(layout.ends)]
        residual = torch.cat([mass / self.flow_scale, (drop - used) / self.pressure_scale], 1)
        slope = y.new_zeros(len(y), y.shape[1], y.shape[1])
        slope[:, :n, n:] = self.incidence[free]
        slope[:, :n, :n] = torch.diag_embed(
            (-leaky / self.flow_scale * self.pressure_scale).detach()
        )
        steep = steep.detach()[:, None, :] * -self.incidence.mT
        slope[:, n:, :n] = steep[:, :, free]
        slope[:, n:, n:] = -torch.diag_embed(rise.detach()) * self.flow_scale / self.pressure_scale
        return residual, slope

    def read(self, y: Tensor) -> Tensor:
        """What ideal meters show, (levels, num_channels)."""
        layout, n = self.scene.layout, len(self.scene.layout.free)
        pressure = self._join_pressures(y)
        widened, _ = linearize_pressure(pressure, self.scene.compliance)
        out = []
        for reading in layout.readings:
            if reading.node >= 0:
                out.append(pressure[:, reading.node])
            elif reading.share is None:
                out.append(y[:, n + reading.tube] * self.flow_scale)
            else:
                a, b = layout.starts[reading.tube], layout.ends[reading.tube]
                there = widened[:, a] + reading.share * (widened[:, b] - widened[:, a])
                out.append(invert_linearized(there, self.scene.compliance))
        return torch.stack(out, 1)

    def _join_pressures(self, y: Tensor) -> Tensor:
        """Of all nodes, (levels, num_nodes) [Pa]."""
        s, layout = self.scene, self.scene.layout
        out = torch.zeros(len(y), len(self.incidence), dtype=torch.float64)
        for k, node in enumerate(layout.free):
            out = out + self.pressure_scale * y[:, k, None] * _make_unit_row(out.shape[1], node)
        held = s.back_pressure + s.outlet_pressure
        for k, node in enumerate(layout.held):
            out = out + held[:, k, None] * _make_unit_row(out.shape[1], node)
        return out

    def _compute_tubes(self) -> tuple[Tensor, Tensor]:
        """Resistance [Pa s/m^3] of each channel at no shear, and its wall rate over the flow."""
        s = self.scene
        narrowing = dict(zip(s.layout.branches, s.narrowing, strict=True))
        rows = [
            self._compute_tube(k, shape, narrowing.get(k))
            for k, shape in enumerate(s.layout.shapes)
        ]
        return torch.stack([r for r, _ in rows]), torch.stack([g for _, g in rows])

    def _compute_tube(self, k: int, shape: str, narrowing: Tensor | None) -> tuple[Tensor, Tensor]:
        s = self.scene
        if shape == "resistance":
            return s.width[k] * s.viscosity / s.nominal_viscosity, _ZERO
        offset = 2.0 * s.wall_offset
        width, height, slip = s.width[k] + offset, s.height[k], s.slip_length
        if shape == "round":
            area = torch.pi / 4.0 * width**2
            conductance = area * width**2 / 32.0 * (1.0 + 8.0 * slip / width)
            rate, power = 8.0 / (area * width), 4
        else:
            if shape == "rectangle":
                height = height + offset
                small, large = torch.minimum(width, height), torch.maximum(width, height)
                around = 1.0 / width + 1.0 / height
            else:
                small, large, around = width, height, 1.0 / width
            conductance = large * small**3 / 12.0 * (1.0 + 6.0 * slip * around)
            if shape == "rectangle":
                conductance = conductance * _correct_for_sides(small / large)
            rate, power = 6.0 / (large * small**2), 3
        resistance = s.viscosity * s.length[k] / conductance
        if narrowing is not None:
            place = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)  # periodic: exact quickly
            hump = torch.cos(torch.pi * (place[:-1] - 0.5)) ** 2
            lodged = ((1.0 - narrowing * hump) ** -power).mean()
            resistance = resistance * (1.0 + THROAT * (lodged - 1.0))
        return resistance, rate

    def _compute_drop(self, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Drop of F that flows need (levels, num_tubes) [Pa], and its slope [Pa s/m^3].

        A thinning fluid by the dissipation of the Newtonian profile: 3 xi^2 for slits.
        """
        s = self.scene
        rate = (self.rate / s.shear_rate * flow)[..., None] * _PLACES
        weight = 3.0 * _PLACES**2 * _SHARES
        thinned = (1.0 + rate**2) ** (-0.5 * s.thinning)
        factor = (thinned * weight).sum(-1)
        bend = (thinned * weight * (1.0 - s.thinning * rate**2 / (1.0 + rate**2))).sum(-1)
        k = torch.zeros(flow.shape[1], dtype=torch.float64)
        for branch in s.layout.branches:
            if s.layout.shapes[branch] != "resistance":
                area = _compute_area(s.layout.shapes[branch], s.width[branch], s.height[branch])
                k = k + 0.5 * s.density * s.entrance_loss / area**2 * _make_unit_row(len(k), branch)
        used = self.resistance * factor * flow + k * flow * flow.abs()
        return used, self.resistance * bend + 2.0 * k * flow.abs()


def _correct_for_sides(ratio: Tensor) -> Tensor:
    """Flow of a rectangle over that of a slit without sides (Bruus 2008, eq. 3.57)."""
    n = torch.arange(1.0, 40.0, 2.0, dtype=torch.float64)
    terms = torch.tanh(0.5 * torch.pi * n / ratio) / n**5
    return 1.0 - 192.0 / torch.pi**5 * ratio * terms.sum()


def _compute_area(shape: str, width: Tensor, height: Tensor) -> Tensor:
    return torch.pi / 4.0 * width**2 if shape == "round" else width * height


def _make_unit_row(count: int, index: int) -> Tensor:
    return torch.eye(count, dtype=torch.float64)[index]
