"""The flow through a channel network on the embedded grid: one factorization for each shape."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.core.errors import ConvergenceError, DiffsimError
from diffsim.stokes import FlowField, Grid, Inlet, Open, StokesFlow
from diffsim.systems.flow_network.corrections import MAX_SWEEPS, FlowDerivatives
from diffsim.systems.flow_network.grid_fits import DEEP, MovingFit, average_corners, integrate_face
from diffsim.systems.flow_network.network import NetworkDevice

SLIP_RTOL = 1e-9


class NetworkFlow:
    """Stokes flow of a network on a grid.

    Args:
        device: Network to be simulated.
        refine: Factor on the cell size [-].

    Attributes:
        cells: Those that fluid fills or may come to fill, by flat index.
        centers: Centers of these cells, (cells, 2) [m].
        num_solved: Shapes that were factorized.
    """

    def __init__(self, device: NetworkDevice, refine: float = 1.0):
        self.device = device
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
            # of less, slender channels lose some per mille; rounding errors grow with it
            bulk_ratio=1e7,
            # of the walls, ten times the usual one: they let less of the flow through, and a wall
            # that moves changes resistances more smoothly
            penalty=200.0,
        )
        self._coordinates = device.coordinates(self.grid.nodes)
        phi = self._level_set(0.0, (0.0,) * len(device.outlets))
        centers = self.grid.centers.reshape(-1, 2)
        widest = device.level_set(centers, 2.0 * spacing, (0.0,) * len(device.outlets))
        self.cells = (widest > 0.0).nonzero()[:, 0]
        self.centers = centers[self.cells]
        deep = (average_corners(phi) > DEEP * spacing).reshape(-1).nonzero()[:, 0]
        fit = MovingFit(centers[deep].numpy(), np.array(device.taps), spacing)
        self._taps = deep, fit
        ends = [device.nodes[n][1] for n in device.outlets]
        self._masks = _mark_nearest(self.grid.nodes[0, :, 1], ends)
        self._sections = self._cut_outlets()

    def solve(
        self, offset: float, slip: float, narrowing: tuple[float, ...]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Resistance, tap, strain (cells, 3, m) and volume (cells,) of a shape.

        One factorization: the pump with open outlets, then a pressure at all outlets but one. The
        components of the strain are scaled so that their sum of squares is the squared shear rate.

        Raises:
            DiffsimError: nothing flows through an outlet of this shape.
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
        profile = profile / integrate_face(
            self.grid, phi, through.reshape(1, *self.grid.node_shape), "x-"
        )
        inlet = torch.zeros(m, len(nodes), 2, dtype=torch.float64)
        inlet[0, :, 0], inlet[0, :, 1] = profile, self._slope * profile
        traction = torch.zeros(m, *self.grid.node_shape, 2, dtype=torch.float64)
        # of the size of the pressures that a unit flow makes
        scale = 12.0 * device.viscosity * device.size[0] / device.segments[0].width ** 3
        raised = torch.zeros(m, m, dtype=torch.float64)
        for k in range(1, m):
            raised[k, k - 1] = scale
            traction[k, -1, :, 0] = -scale * self._masks[k - 1]
        field = self._solve_with_slip(phi, slip, {"inlet": {"in": inlet}, "traction": traction})
        flows = self._compute_outflow(field)
        taps = self._taps[1].at(field.pressure.flatten(1)[:, self._taps[0]])
        # rows: which cases make a unit flow through an outlet
        inverse, is_singular = torch.linalg.inv_ex(flows)
        if is_singular:
            raise DiffsimError(
                f"walls moved by {offset:g} m and branches narrowed by {list(narrowing)} of their "
                f"width leave an outlet without flow; give narrower bounds or typical sizes"
            )
        resistance = inverse @ (taps[:, :1] - raised)
        strain = self._compute_strain(field.velocity)
        return (
            0.5 * (resistance + resistance.T),  # reciprocity, up to the grid's error
            inverse @ (taps[:, 0] - taps[:, 1]),
            torch.einsum("jk,kcs->csj", inverse, strain),
            field.volume_fraction.reshape(-1)[self.cells]
            * float(self.grid.spacing[0] * self.grid.spacing[1]),
        )

    def _solve_with_slip(self, phi: Tensor, slip: float, drive: Mapping[str, Any]) -> FlowField:
        """The flow with the wall velocity that it asks for, by sweeps."""
        flow = self.solver(phi, **drive)
        if slip == 0.0:
            return flow
        spacing = max(self.grid.spacing)
        level = average_corners(phi) / spacing
        derivatives = FlowDerivatives(self.grid, phi, level > 0.0, level > DEEP)
        inside, wall = phi > spacing, torch.zeros(())
        share = 1.0 / (1.0 + 1.5 * abs(slip) / spacing)  # as in ``StokesScene``
        for _ in range(MAX_SWEEPS):
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
            f"sweep {MAX_SWEEPS}, needed {SLIP_RTOL:.1e}; narrow the bounds of the slip",
            residual_norm=change,
            tolerance=SLIP_RTOL,
            num_iters=MAX_SWEEPS,
        )

    def _level_set(self, offset: float, narrowing: tuple[float, ...]) -> Tensor:
        return self.device.level_set_at(*self._coordinates, offset, narrowing)

    def _compute_strain(self, velocity: Tensor) -> Tensor:
        """sqrt(2) D_xx, sqrt(2) D_yy and 2 D_xy at the kept cells, (cases, cells, 3)."""
        dx, dy = self.grid.spacing
        along_x, along_y = velocity.diff(dim=1) / dx, velocity.diff(dim=2) / dy
        x = (0.5 * (along_x[:, :, 1:] + along_x[:, :, :-1])).flatten(1, 2)[:, self.cells]
        y = (0.5 * (along_y[:, 1:] + along_y[:, :-1])).flatten(1, 2)[:, self.cells]
        root = 2.0**0.5
        return torch.stack([root * x[..., 0], root * y[..., 1], x[..., 1] + y[..., 0]], -1)

    def _compute_outflow(self, field: FlowField) -> Tensor:
        """Flows to every outlet, (cases, m) [m^2/s]: means over many sections of the branches, as a
        single one has kinks where the wall passes its nodes; what the walls lose is shared out."""
        cases, m = len(field.velocity), len(self.device.outlets)
        total = torch.zeros(cases, m, dtype=torch.float64)
        part = field.velocity.new_zeros(cases, m, *self.grid.node_shape, 2)
        section = dataclasses.replace(field, velocity=part.flatten(0, 1))
        for index, masks in self._sections:  # written into one field: another each took as long
            part[:, :, index, :, 0] = field.velocity[:, None, index, :, 0] * masks
            total += section.flux(0, index).reshape(cases, m) / len(self._sections)
            part[:, :, index, :, 0] = 0.0
        given = torch.zeros(cases, dtype=torch.float64)
        given[0] = 1.0
        lost = given - total.sum(1)
        return total + lost[:, None] * total.abs() / total.abs().sum(1, keepdim=True)

    def _cut_outlets(self) -> list[tuple[int, Tensor]]:
        """Grid planes across all outlet branches, three widths beyond their junctions or more, and
        which heights belong to which, (m, ny)."""
        device = self.device
        start = max(
            device.nodes[device.segments[k].start][0] + 3.0 * device.segments[k].width
            for k in device.branches
        )
        first = int(start / self.grid.spacing[0]) + 1
        planes = np.linspace(first, self.grid.shape[0] - 1, 12).round().astype(int)
        ends = [[device.nodes[n] for n in device.segments[k][1:3]] for k in device.branches]
        heights = self.grid.nodes[0, :, 1]
        sections = []
        for index in planes.tolist():
            x = index * self.grid.spacing[0]
            axes = [y0 + (x - x0) * (y1 - y0) / (x1 - x0) for (x0, y0), (x1, y1) in ends]
            sections.append((index, _mark_nearest(heights, axes)))
        return sections


def _mark_nearest(heights: Tensor, axes: list[float]) -> Tensor:
    """(len(axes), len(heights)) one for the nearest axis, else zero."""
    away = (heights - torch.tensor(axes, dtype=torch.float64)[:, None]).abs()
    chosen = torch.arange(len(axes))[:, None]
    return (away.argmin(0) == chosen).to(torch.float64)
