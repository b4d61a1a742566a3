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

from diffsim.systems.flow_network.steady import (
    SteadyScene,
    balanced,
    invert_linearized,
    linearize_pressure,
)

RTOL = 1e-11
THROAT = 0.5  # share of a channel's length over which something may lodge in it, a raised cosine
_ZERO = torch.zeros((), dtype=torch.float64)
_X, _W = (torch.from_numpy(v) for v in np.polynomial.legendre.leggauss(8))
_PLACES, _SHARES = 0.5 * (_X + 1.0), 0.5 * _W  # Gauss points of (0, 1)


@dataclass(frozen=True)
class MeterReading:
    """What a meter reads: the flow in a channel, or the pressure at a place."""

    channel: str  # channel of the study that shows it
    # index of the channel whose flow, or inside which the pressure, is read; -1: none
    tube: int = -1
    node: int = -1  # index of the node whose pressure is read; -1: none
    share: float | None = None  # place in the channel, from its start; None: its flow is read


@dataclass(frozen=True, kw_only=True, eq=False)
class TubeLayout:
    """Which channels join which nodes."""

    # nodes, tubes: names of nodes and channels
    nodes: tuple[str, ...]
    tubes: tuple[str, ...]
    # starts, ends: index of the node at either end of each channel
    starts: tuple[int, ...]
    ends: tuple[int, ...]
    shapes: tuple[str, ...]  # "slit", "rectangle", "round" or "resistance", one per channel
    free: tuple[int, ...]  # nodes whose pressure is unknown
    pumps: tuple[int, ...]
    held: tuple[int, ...]  # node of each pressure source
    branches: tuple[int, ...]  # channels that end at a pressure source: what leaves the network
    readings: tuple[MeterReading, ...]  # of the study's channels, in order


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedScene(SteadyScene):
    """One run of the network.

    Numbers, beside those of the description: ``wall_offset`` and ``slip_length`` [m]; ``thinning``,
    s of viscosity (1 + (rate / shear_rate)^2)^(-s / 2); ``compliance``, c of width w (1 + c p)
    [1/Pa]; ``entrance_loss``, K of a loss K rho u^2 / 2 in each branch; ``leak``, flow lost at each
    pump over the pressure there [m^3/(s Pa)]; ``leak_at_NODE``, the same at a node; of each meter,
    branch or pressure that is held ``meter_1``, its gain, ``narrowing_1``, of the middle of the
    branch relative to its width, ``outlet_pressure_1``, on top of the one that is held [Pa].
    """

    layout: TubeLayout  # what joins what
    nominal_viscosity: float  # at which resistances are known [Pa s]
    density: float  # of the fluid [kg/m^3]
    shear_rate: float  # beyond which the fluid thins [1/s]

    def simulate(self) -> Tensor:
        """Readings, (num_samples, num_channels).

        Raises:
            ConvergenceError: flows and pressures do not balance; an effect is too large.
        """
        drive, held, level = self.levels()
        balance = _Balance(self, drive, held)
        readings = self.layout.readings
        offsets = [self.numbers.get(f"pressure_zero_{r.channel}", _ZERO) for r in readings]
        shown = balance.read(balance.solved()) * self.several("meter", len(readings)) + torch.stack(
            offsets
        )
        return self.instruments.read_late(shown[level], self.grid)


class _Balance:
    """Mass and pressures of all levels; unknowns are free pressures [Pa] and flows over a scale."""

    def __init__(self, scene: LumpedScene, drive: Tensor, held: Tensor):
        self.scene, layout = scene, scene.layout
        self.drive = drive
        self.held = held + scene.several("outlet_pressure", len(layout.held))
        self.compliance, self.thinning = scene.number("compliance"), scene.number("thinning")
        self.resistance, self.rate = self._compute_tubes()
        nodes = 1 + max(*layout.starts, *layout.ends)
        incidence = torch.zeros(nodes, len(layout.starts), dtype=torch.float64)
        for k, (a, b) in enumerate(zip(layout.starts, layout.ends, strict=True)):
            incidence[a, k] -= 1.0
            incidence[b, k] += 1.0
        self.incidence = incidence
        pumped = float(drive.detach().abs().max()) if drive.numel() else 0.0
        pushed = float(self.held.detach().abs().max())
        mean = float(self.resistance.detach().mean())
        self.flow_scale = max(pumped, pushed / mean, 1e-6 / mean)
        self.pressure_scale = self.flow_scale * mean
        # made here, with gradients: the search for the balance has none
        self.units = torch.eye(nodes, dtype=torch.float64)  # a row for each node
        self.free, self.starts, self.ends = (
            torch.tensor(list(places), dtype=torch.long)
            for places in (layout.free, layout.starts, layout.ends)
        )
        self.entrance = self._compute_entrance_losses()
        self.given, self.leaky = self._compute_exchange()
        self.slope = self._make_constant_slope()

    def solved(self) -> Tensor:
        """The unknowns, (levels, num_free + num_tubes)."""
        unknowns = len(self.scene.layout.free) + len(self.scene.layout.starts)
        start = torch.zeros(len(self.held), unknowns, dtype=torch.float64)
        return balanced(self.at, start, self.scene.rtol)

    def at(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Residual (levels, unknowns) over its scales [-], and its slope."""
        n, free = len(self.free), self.free
        pressure, flow = self._join_pressures(y), y[:, n:] * self.flow_scale
        mass = (flow @ self.incidence.mT + self.given).index_select(1, free)
        mass = mass - self.leaky * pressure.index_select(1, free)
        widened, steep = linearize_pressure(pressure, self.compliance)
        used, rise = self._compute_drop(flow)
        drop = widened.index_select(1, self.starts) - widened.index_select(1, self.ends)
        residual = torch.cat([mass / self.flow_scale, (drop - used) / self.pressure_scale], 1)
        slope = self.slope.repeat(len(y), 1, 1)
        steep = steep.detach()[:, None, :] * -self.incidence.mT
        slope[:, n:, :n] = steep.index_select(2, free)
        tubes = slope[:, n:, n:].diagonal(dim1=-2, dim2=-1)
        tubes.copy_(-rise.detach() * self.flow_scale / self.pressure_scale)
        return residual, slope

    def _compute_exchange(self) -> tuple[Tensor, Tensor]:
        """What pumps give each node, (levels, num_nodes) [m^3/s], and what leaks from each free one
        over its pressure, (num_free,) [m^3/(s Pa)]."""
        s, layout = self.scene, self.scene.layout
        pumps = torch.zeros(len(self.incidence), dtype=torch.float64)
        given = torch.zeros(len(self.held), len(pumps), dtype=torch.float64)
        for k, node in enumerate(layout.pumps):
            pumps[node] += 1.0
            given = given + self.drive[:, k, None] * self.units[node]
        leaks = [s.number(f"leak_at_{layout.nodes[node]}") for node in layout.free]
        leaky = s.number("leak") * pumps[self.free]
        return given, leaky + (torch.stack(leaks) if leaks else _ZERO)

    def _make_constant_slope(self) -> Tensor:
        """What every slope of the residual has, (num_unknowns, num_unknowns)."""
        layout, n = self.scene.layout, len(self.scene.layout.free)
        unknowns = n + len(layout.starts)
        slope = torch.zeros(unknowns, unknowns, dtype=torch.float64)
        slope[:n, n:] = self.incidence[self.free]
        slope[:n, :n] = torch.diag_embed(
            (-self.leaky / self.flow_scale * self.pressure_scale).detach()
        )
        return slope

    def read(self, y: Tensor) -> Tensor:
        """What ideal meters show, (levels, num_channels)."""
        layout, n = self.scene.layout, len(self.scene.layout.free)
        pressure = self._join_pressures(y)
        widened, _ = linearize_pressure(pressure, self.compliance)
        out = []
        for reading in layout.readings:
            if reading.node >= 0:
                out.append(pressure[:, reading.node])
            elif reading.share is None:
                out.append(y[:, n + reading.tube] * self.flow_scale)
            else:
                a, b = layout.starts[reading.tube], layout.ends[reading.tube]
                there = widened[:, a] + reading.share * (widened[:, b] - widened[:, a])
                out.append(invert_linearized(there, self.compliance))
        return torch.stack(out, 1)

    def _join_pressures(self, y: Tensor) -> Tensor:
        """Of all nodes, (levels, num_nodes) [Pa]."""
        layout = self.scene.layout
        out = torch.zeros(len(y), len(self.incidence), dtype=torch.float64)
        for k, node in enumerate(layout.free):
            out = out + self.pressure_scale * y[:, k, None] * self.units[node]
        for k, node in enumerate(layout.held):
            out = out + self.held[:, k, None] * self.units[node]
        return out

    def _compute_tubes(self) -> tuple[Tensor, Tensor]:
        """Resistance [Pa s/m^3] of each channel at no shear, and its wall rate over the flow."""
        branches = self.scene.layout.branches
        narrowing = {k: self.scene.number(f"narrowing_{i + 1}") for i, k in enumerate(branches)}
        count = len(self.scene.layout.tubes)
        rows = [self._compute_tube(k, narrowing.get(k)) for k in range(count)]
        return torch.stack([r for r, _ in rows]), torch.stack([g for _, g in rows])

    def _size_of(self, k: int, size: str) -> Tensor:
        """A size of a channel [m], or its resistance."""
        return self.scene.numbers[f"{size}_{self.scene.layout.tubes[k]}"]

    def _compute_tube(self, k: int, narrowing: Tensor | None) -> tuple[Tensor, Tensor]:
        s, shape = self.scene, self.scene.layout.shapes[k]
        viscosity = s.number("viscosity")
        if shape == "resistance":
            return self._size_of(k, "resistance") * viscosity / s.nominal_viscosity, _ZERO
        offset, slip = 2.0 * s.number("wall_offset"), s.number("slip_length")
        width = self._size_of(k, "diameter" if shape == "round" else "width") + offset
        if shape == "round":
            area = torch.pi / 4.0 * width**2
            conductance = area * width**2 / 32.0 * (1.0 + 8.0 * slip / width)
            rate, power = 8.0 / (area * width), 4
        else:
            height = self._size_of(k, "height")
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
        resistance = viscosity * self._size_of(k, "length") / conductance
        if narrowing is not None:
            place = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)  # periodic: exact quickly
            hump = torch.cos(torch.pi * (place[:-1] - 0.5)) ** 2
            lodged = ((1.0 - narrowing * hump) ** -power).mean()
            resistance = resistance * (1.0 + THROAT * (lodged - 1.0))
        return resistance, rate

    def _compute_area(self, k: int) -> Tensor:
        if self.scene.layout.shapes[k] == "round":
            return torch.pi / 4.0 * self._size_of(k, "diameter") ** 2
        return self._size_of(k, "width") * self._size_of(k, "height")

    def _compute_drop(self, flow: Tensor) -> tuple[Tensor, Tensor]:
        """Drop of F that flows need (levels, num_tubes) [Pa], and its slope [Pa s/m^3].

        A thinning fluid by the dissipation of the Newtonian profile: 3 xi^2 for slits.
        """
        s = self.scene
        rate = (self.rate / s.shear_rate * flow)[..., None] * _PLACES
        weight = 3.0 * _PLACES**2 * _SHARES
        thinned = (1.0 + rate**2) ** (-0.5 * self.thinning)
        factor = (thinned * weight).sum(-1)
        bend = (thinned * weight * (1.0 - self.thinning * rate**2 / (1.0 + rate**2))).sum(-1)
        k = self.entrance
        used = self.resistance * factor * flow + k * flow * flow.abs()
        return used, self.resistance * bend + 2.0 * k * flow.abs()

    def _compute_entrance_losses(self) -> Tensor:
        """Drop over the square of the flow, (num_tubes,)."""
        s, layout = self.scene, self.scene.layout
        k = torch.zeros(len(layout.tubes), dtype=torch.float64)
        rows = torch.eye(len(k), dtype=torch.float64)
        for branch in layout.branches:
            if layout.shapes[branch] != "resistance":
                area = self._compute_area(branch)
                k = k + 0.5 * s.density * s.number("entrance_loss") / area**2 * rows[branch]
        return k


def _correct_for_sides(ratio: Tensor) -> Tensor:
    """Flow of a rectangle over that of a slit without sides (Bruus 2008, eq. 3.57)."""
    n = torch.arange(1.0, 40.0, 2.0, dtype=torch.float64)
    terms = torch.tanh(0.5 * torch.pi * n / ratio) / n**5
    return 1.0 - 192.0 / torch.pi**5 * ratio * terms.sum()
