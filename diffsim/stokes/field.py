"""What a flow solve returns, and what can be asked of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import require, require_shape, require_tensor
from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere, require_unmapped
from diffsim.core.record import Solve
from diffsim.stokes import _ops_cut
from diffsim.stokes.grid import Grid


@dataclass(frozen=True)
class FlowField:
    """A Stokes flow.

    Attributes:
        grid: The grid.
        phi: Level set at the nodes, (*node_shape,), > 0 in the fluid.
        velocity: (cases, *node_shape, dim) [m/s]; beyond the wall its smooth continuation in cells
            that are cut, zero elsewhere.
        pressure: One value per cell, (cases, *shape) [Pa]; zero in solid cells.
        volume_fraction: Fluid share of every cell, (*shape) [-].
        stats: Figures per case: "num_iters", "divergence" (root mean square dilatation of cells
            relative to max speed / longest side of the box), "converged", "net_inflow" (net over
            gross flux of the worst part of the fluid without an open face), "residual" (of momentum
            and continuity, relative to what drives the flow), "pressure_error" (estimated root
            mean square, relative; of a direct solver's incompressible flow, else zero),
            "imbalance" (``mass_report``); no gradients.
        solve: Why every case ended, with the relative residual, or with the divergence or the error
            of the pressures where that was too large; no gradients.
    """

    grid: Grid
    phi: Tensor
    velocity: Tensor
    pressure: Tensor
    volume_fraction: Tensor
    stats: dict[str, Tensor]
    solve: Solve | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.grid, Grid):
            raise TypeError(f"grid must be a Grid, got {type(self.grid).__name__}")
        nodes = self.grid.node_shape
        require("phi", self.phi, nodes)
        require_shape("velocity", self.velocity, ("cases", *nodes, self.grid.dim))
        require_tensor("pressure", self.pressure)
        require_tensor("volume_fraction", self.volume_fraction)
        if not isinstance(self.stats, Mapping):
            raise TypeError(f"stats must be a Mapping, got {type(self.stats).__name__}")

    @checked
    def flux(self, axis: int, index: int) -> Tensor:
        """Volume flow through the fluid part of a grid plane, positive along the axis.

        In 2D it is what the flow's equations conserve: the same through every plane between inlet
        and outlet, up to the divergence. In 3D cells on both sides of a plane take a little
        different parts of it as fluid, and this is the mean.

        Args:
            axis: The plane's normal.
            index: Index of the plane, 0 to ``grid.shape[axis]``; negative counts from the end.

        Returns:
            (cases,) [m^dim/s]. Gradient: velocity and phi.
        """
        if not 0 <= axis < self.grid.dim:
            raise ValueError(f"axis must lie in [0, {self.grid.dim}), got {axis}")
        count = self.grid.shape[axis] + 1
        if not -count <= index < count:
            raise ValueError(f"index must lie in [-{count}, {count}), got {index}")
        cases = self.velocity.shape[0]
        return _ops_cut.plane_flux(
            phi=self.phi.reshape(-1),
            velocity=self.velocity.reshape(cases, self.grid.num_nodes, self.grid.dim),
            cells=list(self.grid.shape),
            spacing=list(self.grid.spacing),
            axis=axis,
            index=index % count,
        )

    def mass_report(self) -> dict[str, Tensor]:
        """Volume flow out of the box through every face, and what does not add up.

        Returns:
            Face name to (cases,) outflow [m^dim/s]; "imbalance": their sum relative to the inflow,
            or to 1e-9 of the largest speed over the whole box where less flows in; "divergence": as
            in ``stats``.
        """
        if "divergence" not in self.stats:
            raise ValueError("stats must hold 'divergence', as those of a flow that was solved do")
        report = {}
        for face in self.grid.faces:
            axis, side = self.grid.face_axis(face)
            report[face] = self.flux(axis, -side) * (1.0 if side else -1.0)
        flows = torch.stack(list(report.values()))
        inflow = torch.clamp(-flows, min=0.0).sum(0)
        speed = self.velocity.detach().abs().flatten(1).amax(1)
        box = sum(math.prod(self.grid.size) / size for size in self.grid.size)
        floor = (1e-9 * box * speed).clamp(min=torch.finfo(flows.dtype).tiny)
        report["imbalance"] = flows.sum(0) / torch.maximum(inflow, floor)
        report["divergence"] = self.stats["divergence"]
        return report

    def with_imbalance(self) -> FlowField:
        """This field with the imbalance of ``mass_report`` in its stats."""
        constant = dataclasses.replace(self, phi=self.phi.detach(), velocity=self.velocity.detach())
        imbalance = constant.mass_report()["imbalance"]
        return dataclasses.replace(self, stats={**self.stats, "imbalance": imbalance})

    @checked
    def sample(self, points: Tensor) -> Tensor:
        """Velocity at points, multilinear between the nodes.

        Args:
            points: Points, (n, dim) float64 in the box [m].

        Returns:
            (cases, n, dim) [m/s]. Gradient: velocity and points.

        Raises:
            ValueError: points outside of the box.
        """
        grid = self.grid
        points = require("points", points, ("n", grid.dim), torch.float64)
        origin = torch.tensor(grid.origin, dtype=torch.float64)
        at = (points - origin) / torch.tensor(grid.spacing, dtype=torch.float64)
        cells = torch.tensor(grid.shape, dtype=torch.float64)
        outside = ((at < -1e-9) | (at > cells + 1e-9)).any(-1)
        if anywhere(outside):
            require_unmapped(points=points)
            first = points[outside][0].tolist()
            raise ValueError(
                f"{int(outside.sum())} points lie outside of the box, the first at {first}"
            )
        low = torch.minimum(at.detach().floor().clamp(min=0.0), cells - 1.0)
        share = at - low
        values = self.velocity.reshape(len(self.velocity), grid.num_nodes, grid.dim)
        stride = [1] * grid.dim
        for a in range(grid.dim - 2, -1, -1):
            stride[a] = stride[a + 1] * grid.node_shape[a + 1]
        total = values.new_zeros(values.shape[0], len(points), grid.dim)
        for corner in range(1 << grid.dim):
            bits = [(corner >> a) & 1 for a in range(grid.dim)]
            weight = torch.stack(
                [share[:, a] if b else 1.0 - share[:, a] for a, b in enumerate(bits)]
            ).prod(0)
            node = sum((low[:, a].long() + b) * stride[a] for a, b in enumerate(bits))
            total = total + weight[:, None] * values[:, node]
        return total
