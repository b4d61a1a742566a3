"""Flows of unit size through a channel network on the embedded grid, kept by the walls' shape.

A steady slow flow is linear in what drives it. For every shape of the walls the Stokes simulator is
asked once: one factorisation, one solve for each independent way through the network. What drives
the flow, the fluid and the sensors are then changed without another solve.
"""

from __future__ import annotations

import dataclasses
from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffsim.diagnose.beds.stokes.corrections import FlowDerivatives
from diffsim.diagnose.beds.stokes.moving_fit import MovingFit
from diffsim.diagnose.beds.stokes.network import NetworkDevice
from diffsim.errors import ConvergenceError
from diffsim.stokes import FlowField, Grid, Inlet, Open, StokesFlow
from diffsim.stokes.devices.losses import integral, on_face

BULK_RATIO = 1e7
"""Less, and slender channels lose some per mille of the flow; rounding errors grow with it."""

PENALTY = 200.0
"""Of the walls, ten times the usual one: they let less of the flow through, and so a wall that moves
changes resistances more smoothly."""

DEEP = 0.75
"""Pressures are fitted to cells so many spacings from the wall."""

SLIP_RTOL = 1e-9
MAX_SLIP_SWEEPS = 60
NUM_KEPT, NUM_RECENT = 256, 32
NUM_SECTIONS = 12
NUM_LEVELS = 24
"""Of shear in each channel: cells of about the same shear are one group."""
STEPS = {"offset": 5e-6, "slip": 5e-6, "narrowing": 0.05}
"""Between shapes that are simulated, [m], [m] and [-]; others are interpolated. Smaller than any
change of shape that matters, larger than the kinks of the flow where a wall passes nodes."""


class Shape(NamedTuple):
    """Walls of a network: all outwards [m], slip length [m], narrowing of each branch [-]."""

    offset: Tensor
    slip: Tensor
    narrowing: Tensor


@dataclass(frozen=True, eq=False)
class UnitFlows:
    """Flows with all that the pump gives leaving through one outlet, at the nominal viscosity.

    Attributes:
        resistance: Pressure drop from the pump to outlet i per flow to outlet j, (m, m)
            [Pa s/m^2].
        tap: Pressure drop from the pump to the tap per flow to outlet j, (m,) [Pa s/m^2].
        energy: Products of the strain rates of the unit flows, 2 D_i : D_j, integrated over groups
            of cells, (groups, m, m) [1/m^2].
        volume: Fluid area of the groups, (groups,) [m^2].
    """

    resistance: Tensor
    tap: Tensor
    energy: Tensor
    volume: Tensor


class Groups(NamedTuple):
    """Cells of one channel with about the same shear, and what they share.

    Attributes:
        of_cell: Group of every kept cell, (cells,).
        owner: Channel, (groups,).
        height: Mean y [m], (groups,).
        before_tap: Between the two pressure sensors, (groups,) bool.
        after_pump: Beyond the first of them, (groups,) bool.
    """

    of_cell: Tensor
    owner: Tensor
    height: Tensor
    before_tap: Tensor
    after_pump: Tensor


class UnitFlowTable:
    """Unit flows of any shape: simulated on a lattice of shapes, interpolated smoothly between.

    Args:
        device: The network.
        refine: Factor on the cell size.
        corrected: Multiply resistances by what halving the cells once changes them in the nominal
            shape, extrapolated to second order (Richardson).
    """

    def __init__(self, device: NetworkDevice, refine: float = 1.0, *, corrected: bool = True):
        self.device, self.refine, self.corrected = device, refine, corrected
        self.grid = Grid([max(1, round(n / refine)) for n in device.cells], size=device.size)
        self.num_solved = 0
        spacing = max(self.grid.spacing)
        inlet = device.segments[0]
        start, self._slope = device.nodes[inlet.start], device.inlet_slope
        height = start[1] - self._slope * start[0]  # of its axis on the left face
        reach = 0.5 * inlet.width * (1.0 + self._slope**2) ** 0.5 + 1.01 * spacing
        self.solver = StokesFlow(
            self.grid,
            [Inlet("x-", "in", lambda x: (x[:, 1] - height).abs() < reach), Open("x+")],
            viscosity=device.viscosity,
            bulk_ratio=BULK_RATIO,
            penalty=PENALTY,
        )
        phi = self._level_set(0.0, (0.0,) * len(device.outlets))
        centers = self.grid.centers.reshape(-1, 2)
        widest = device.level_set(centers, 2.0 * spacing, (0.0,) * len(device.outlets))
        self.cells = (widest > 0.0).nonzero()[:, 0]
        self.centers = centers[self.cells]
        deep = (_at_centers(phi) > DEEP * spacing).reshape(-1).nonzero()[:, 0]
        fit = MovingFit(centers[deep].numpy(), np.array(device.taps), spacing)
        self._taps = deep, fit
        ends = [device.nodes[n][1] for n in device.outlets]
        self._masks = _nearest(self.grid.nodes[0, :, 1], ends)
        self._sections = self._cut()
        self._recent: OrderedDict[tuple[float, ...], UnitFlows] = OrderedDict()
        self._kept: OrderedDict[tuple[int, ...], UnitFlows] = OrderedDict()

    def at(self, shape: Shape) -> UnitFlows:
        """Unit flows of a shape; gradients pass to it through the interpolation."""
        if any(part.requires_grad for part in shape):
            return self._between(shape)
        key = tuple(torch.cat([part.reshape(-1) for part in shape]).tolist())
        if key not in self._recent:
            self._recent[key] = self._between(shape)
            if len(self._recent) > NUM_RECENT:
                self._recent.popitem(last=False)
        return self._recent[key]

    def _between(self, shape: Shape) -> UnitFlows:
        coordinates = [
            shape.offset / STEPS["offset"],
            shape.slip / STEPS["slip"],
            *(shape.narrowing / STEPS["narrowing"]).unbind(),
        ]
        axes = [_interpolation(c) for c in coordinates]
        parts = []
        for corner in product(*axes):
            # a product of two weights that are zero has neither value nor slope
            if sum(float(w.detach()) == 0.0 for _, w in corner) > 1:
                continue
            weight = reduce(lambda a, b: a * b, (w for _, w in corner))
            parts.append((weight, self._solved(tuple(k for k, _ in corner))))
        if len(parts) == 1 and not parts[0][0].requires_grad:
            return parts[0][1]
        return UnitFlows(
            *(
                torch.stack([w * getattr(u, name) for w, u in parts]).sum(0)
                for name in ("resistance", "tap", "energy", "volume")
            )
        )

    @cached_property
    def groups(self) -> Groups:
        """Groups of the nominal shape; they serve all shapes."""
        device = self.device
        owner = device.owners(self.centers)
        place = device.coordinates(self.centers)[1][:, 0]
        # the inlet channel in three parts, then the others
        part = torch.where(owner > 0, owner + 2, (place > 0.0).long() + (place > device.tap).long())
        _, _, strain, volume = self._nominal
        shear = (strain**2).sum((1, 2))
        shear = torch.where(volume > 0.0, shear, torch.inf)  # fluid only where walls move out
        of_cell = torch.zeros(len(part), dtype=torch.int64)
        for k in range(int(part.max()) + 1):
            own = (part == k).nonzero()[:, 0]
            rank = shear[own].argsort().argsort()
            of_cell[own] = k * NUM_LEVELS + rank * NUM_LEVELS // max(len(own), 1)
        used, of_cell = torch.unique(of_cell, return_inverse=True)
        part = used // NUM_LEVELS
        area = torch.zeros(len(used), dtype=torch.float64).index_add(0, of_cell, volume)
        moment = torch.zeros_like(area).index_add(0, of_cell, volume * self.centers[:, 1])
        return Groups(
            of_cell, (part - 2).clamp(min=0), moment / area.clamp(min=1e-300), part == 1, part > 0
        )

    @cached_property
    def _nominal(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        with torch.no_grad():
            return self._solve(0.0, 0.0, (0.0,) * len(self.device.outlets))

    @cached_property
    def _correction(self) -> tuple[Tensor, Tensor]:
        """Factors on resistance and tap."""
        resistance, tap, *_ = self._nominal
        if not self.corrected:
            return torch.ones_like(resistance), torch.ones_like(tap)
        finer = UnitFlowTable(self.device, 0.5 * self.refine, corrected=False)
        fine_resistance, fine_tap, *_ = finer._nominal
        return (
            (4.0 * fine_resistance / resistance - 1.0) / 3.0,
            (4.0 * fine_tap / tap - 1.0) / 3.0,
        )

    def _solved(self, key: tuple[int, ...]) -> UnitFlows:
        if key not in self._kept:
            with torch.no_grad():
                self._kept[key] = self.simulated(
                    key[0] * STEPS["offset"],
                    key[1] * STEPS["slip"],
                    tuple(k * STEPS["narrowing"] for k in key[2:]),
                )
            if len(self._kept) > NUM_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(key)
        return self._kept[key]

    def simulated(self, offset: float, slip: float, narrowing: tuple[float, ...]) -> UnitFlows:
        """Unit flows of a shape without interpolation; lengths in [m], narrowing relative."""
        is_nominal = not any((offset, slip, *narrowing))
        resistance, tap, strain, volume = (
            self._nominal if is_nominal else self._solve(offset, slip, narrowing)
        )
        groups, m = self.groups, len(tap)
        count = len(groups.owner)
        products = torch.einsum("csi,csj,c->cij", strain, strain, volume)
        factor, tap_factor = self._correction
        return UnitFlows(
            resistance=resistance * factor,
            tap=tap * tap_factor,
            energy=products.new_zeros(count, m, m).index_add(0, groups.of_cell, products),
            volume=volume.new_zeros(count).index_add(0, groups.of_cell, volume),
        )

    def _solve(
        self, offset: float, slip: float, narrowing: tuple[float, ...]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Resistance, tap, strain (cells, 3, m) and volume (cells,) of a shape.

        One factorisation: the pump with open outlets, then a pressure at all outlets but one. The
        components of the strain are scaled so that their sum of squares is the squared shear rate.
        """
        self.num_solved += 1
        device, m = self.device, len(self._masks)
        phi = self._level_set(offset, narrowing)
        nodes = self.solver.boundary.inlets["in"]
        near = phi.reshape(-1)[nodes]
        across = near * (device.segments[0].width + 2.0 * offset - near)
        profile = across + slip * (device.segments[0].width + 2.0 * offset)
        through = torch.zeros(self.grid.num_nodes, dtype=torch.float64)
        through[nodes] = profile
        profile = profile / self._through(phi, through.reshape(1, *self.grid.node_shape), "x-")
        inlet = torch.zeros(m, len(nodes), 2, dtype=torch.float64)
        inlet[0, :, 0], inlet[0, :, 1] = profile, self._slope * profile
        traction = torch.zeros(m, *self.grid.node_shape, 2, dtype=torch.float64)
        # of the size of the pressures that a unit flow makes
        scale = 12.0 * device.viscosity * device.size[0] / device.segments[0].width ** 3
        raised = torch.zeros(m, m, dtype=torch.float64)
        for k in range(1, m):
            raised[k, k - 1] = scale
            traction[k, -1, :, 0] = -scale * self._masks[k - 1]
        field = self._slipping(phi, slip, {"inlet": {"in": inlet}, "traction": traction})
        flows = self._outflow(field)
        taps = self._taps[1].at(field.pressure.flatten(1)[:, self._taps[0]])
        inverse = torch.linalg.inv(flows)  # rows: which cases make a unit flow through an outlet
        resistance = inverse @ (taps[:, :1] - raised)
        strain = self._strain(field.velocity)
        return (
            0.5 * (resistance + resistance.T),  # reciprocity, up to the grid's error
            inverse @ (taps[:, 0] - taps[:, 1]),
            torch.einsum("jk,kcs->csj", inverse, strain),
            field.volume_fraction.reshape(-1)[self.cells]
            * float(self.grid.spacing[0] * self.grid.spacing[1]),
        )

    def _slipping(self, phi: Tensor, slip: float, drive) -> FlowField:
        """The flow with the wall velocity that it asks for, by sweeps."""
        flow = self.solver(phi, **drive)
        if slip == 0.0:
            return flow
        spacing = max(self.grid.spacing)
        level = _at_centers(phi) / spacing
        derivatives = FlowDerivatives(self.grid, phi, level > 0.0, level > DEEP)
        inside, wall = phi > spacing, torch.zeros(())
        share = 1.0 / (1.0 + 1.5 * abs(slip) / spacing)  # as in ``StokesScene``
        for _ in range(MAX_SLIP_SWEEPS):
            gradient = derivatives.gradient(flow.velocity)
            asked = slip * derivatives.slip_velocity(gradient, phi)
            wall = share * asked + (1.0 - share) * wall
            before, flow = flow, self.solver(phi, wall_velocity=wall, **drive)
            moved = (flow.velocity - before.velocity)[:, inside].flatten(1).abs().amax(1)
            change = float((moved / flow.velocity[:, inside].flatten(1).abs().amax(1)).max())
            if change < SLIP_RTOL:
                return flow
        raise ConvergenceError(
            f"the flow with slip length {slip:g} m changed by {change:.1e} of its largest speed in "
            f"sweep {MAX_SLIP_SWEEPS}, needed {SLIP_RTOL:.1e}; narrow the bounds of the slip",
            residual_norm=change,
            tolerance=SLIP_RTOL,
            num_iters=MAX_SLIP_SWEEPS,
        )

    def _level_set(self, offset: float, narrowing: tuple[float, ...]) -> Tensor:
        return self.device.level_set(self.grid.nodes, offset, narrowing)

    def _strain(self, velocity: Tensor) -> Tensor:
        """sqrt(2) D_xx, sqrt(2) D_yy and 2 D_xy at the kept cells, (cases, cells, 3)."""
        dx, dy = self.grid.spacing
        along_x, along_y = velocity.diff(dim=1) / dx, velocity.diff(dim=2) / dy
        x = (0.5 * (along_x[:, :, 1:] + along_x[:, :, :-1])).flatten(1, 2)[:, self.cells]
        y = (0.5 * (along_y[:, 1:] + along_y[:, :-1])).flatten(1, 2)[:, self.cells]
        root = 2.0**0.5
        return torch.stack([root * x[..., 0], root * y[..., 1], x[..., 1] + y[..., 0]], -1)

    def _through(self, phi: Tensor, along_x: Tensor, face: str) -> Tensor:
        """Integral of nodal values (cases, *node_shape) over the fluid part of a face, (cases,)."""
        empty = phi.new_zeros(0)
        field = FlowField(self.grid, phi, along_x[..., None], empty, empty, {})
        return integral(field, face, on_face(self.grid, along_x, face))

    def _outflow(self, field: FlowField) -> Tensor:
        """Flows to every outlet, (cases, m) [m^2/s]: means over many sections of the branches, as a
        single one has kinks where the wall passes its nodes; what the walls lose is shared out."""
        cases, m = len(field.velocity), len(self.device.outlets)
        total = torch.zeros(cases, m, dtype=torch.float64)
        for index, masks in self._sections:
            along = field.velocity[:, None, index, :, 0] * masks
            part = field.velocity.new_zeros(cases, m, *self.grid.node_shape, 2)
            part[:, :, index, :, 0] = along
            section = dataclasses.replace(field, velocity=part.flatten(0, 1))
            total += section.flux(0, index).reshape(cases, m) / len(self._sections)
        given = torch.zeros(cases, dtype=torch.float64)
        given[0] = 1.0
        lost = given - total.sum(1)
        return total + lost[:, None] * total.abs() / total.abs().sum(1, keepdim=True)

    def _cut(self) -> list[tuple[int, Tensor]]:
        """Grid planes across all outlet branches, and which heights belong to which, (m, ny)."""
        device = self.device
        start = max(
            device.nodes[device.segments[k].start][0] + device.segments[k].width
            for k in device.branches
        )
        first = int(start / self.grid.spacing[0]) + 1
        planes = np.linspace(first, self.grid.shape[0] - 1, NUM_SECTIONS).round().astype(int)
        ends = [[device.nodes[n] for n in device.segments[k][1:3]] for k in device.branches]
        heights = self.grid.nodes[0, :, 1]
        sections = []
        for index in planes.tolist():
            x = index * self.grid.spacing[0]
            axes = [y0 + (x - x0) * (y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in ends]
            sections.append((index, _nearest(heights, axes)))
        return sections


def _nearest(heights: Tensor, axes: list[float]) -> Tensor:
    """(len(axes), len(heights)) one for the nearest axis, else zero."""
    away = (heights - torch.tensor(axes, dtype=torch.float64)[:, None]).abs()
    chosen = torch.arange(len(axes))[:, None]
    return (away.argmin(0) == chosen).to(torch.float64)


def _at_centers(nodal: Tensor) -> Tensor:
    return 0.25 * (nodal[1:, 1:] + nodal[:-1, 1:] + nodal[1:, :-1] + nodal[:-1, :-1])


def _interpolation(at: Tensor) -> list[tuple[int, Tensor]]:
    """Whole numbers around a coordinate and their weights: the quintic between two nodes whose
    values, central slopes and central second derivatives it takes, so that both stay continuous.
    Nodes with neither weight nor, where it is asked for, slope are left out."""
    low = int(torch.floor(at.detach()))
    t = at - low
    cube = t**3
    slope_0 = t - cube * (6.0 - t * (8.0 - 3.0 * t))
    slope_1 = -cube * (4.0 - t * (7.0 - 3.0 * t))
    bend_0 = 0.5 * t * t * (1.0 - t) ** 3
    bend_1 = 0.5 * cube * (1.0 - t) ** 2
    value_1 = cube * (10.0 - t * (15.0 - 6.0 * t))
    weights = (
        bend_0 - 0.5 * slope_0,
        1.0 - value_1 - 2.0 * bend_0 - 0.5 * slope_1 + bend_1,
        value_1 + 0.5 * slope_0 + bend_0 - 2.0 * bend_1,
        0.5 * slope_1 + bend_1,
    )
    is_node = float(t.detach()) == 0.0
    needed = (at.requires_grad, True, at.requires_grad, False) if is_node else (True,) * 4
    return [(low - 1 + k, w) for k, w in enumerate(weights) if needed[k]]
