"""The published quasi-incompressible formulation of Stokes flow, kept for comparison.

It loses accuracy as Poisson's ratio nears 0.5 (locking) and has a compressibility error below;
``diffsim.stokes.StokesFlow`` has neither. Thesis 4.2.4-4.2.6, Fig. 4-27.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

from benchmarks.thesis_stokes.cut_volume import Plane, cut_area, cut_volume, fit_plane
from benchmarks.thesis_stokes.kkt import MIN_SHARE, CellTables, KktFunction
from diffsim.core.check import require_choice, require_number
from diffsim.stokes import Boundary, FlowField, Grid, Inlet, Open, Wall
from diffsim.stokes.boundary import refuse_net_inflow
from diffsim.stokes.flow import WALL_KINDS, flow_inputs

# Walls smaller than this share of a face hold nothing (the flow jumps by little as a wall shrinks
# past it); the published code's cutoff is another, see ``ThesisFlow``.
MIN_AREA = 0.06


class _Rows(NamedTuple):
    """Boundary rows C v = d of the cut cells."""

    cells: Tensor  # flat index of each cut cell, (num_cut,) int64
    # mean over the wall in the cell, (num_cut, rows, corners, dim) [-]; ``rows`` is dim for no
    # slip, 1 for no separation
    weights: Tensor
    values: Tensor  # d, (cases, num_cut, rows) [m/s]


class ThesisFlow(nn.Module):
    """Quasi-incompressible Stokes flow on a grid, as published: for comparison, not for design.

    minimize  sum over sub-cells of volume * (eta |D|^2 + eta nu / (1 - 2 nu) (tr D)^2 - f.v)
              - sum over open sub-faces of area * t.v
    where     the mean of v over the wall in every cut cell equals the wall's velocity
              ("no_slip"), or only its normal component does ("no_separation")

    Multilinear velocities; each cell is cut by the plane that fits the level set at its corners;
    2^dim quadrature points at the centers of a cell's sub-cells, weighted by exact fluid volumes,
    in full cells too (thesis eqs. 4.67-4.74). Body force f and traction t are not in the thesis;
    they are integrated likewise. The KKT system (4.75) is solved by a sparse LU; its factor serves
    all cases and the adjoint.

    Locks: as nu -> 0.5 the error no longer falls with the cell size; at smaller nu the flow is
    compressible, div v = -p / lambda with lambda = 2 eta nu / (1 - 2 nu). Nodes beyond the wall
    that belong to slivers of fluid only can take large velocities, and since rows hold means,
    velocities that alternate along a wall pass them.

    Cutoffs: the published code has one, ``vol_tol`` = 1e-3. It drops cells with a fluid share below
    ``vol_tol`` together with their walls, and takes those above 1 - ``vol_tol`` for full. Walls
    close to a layer of nodes are lost that way. Here cells carry energy from a fluid share of
    ``MIN_SHARE`` = 1e-9 on, and walls hold from an area of ``MIN_AREA`` = 0.06 of a cell's face on.
    Both cutoffs agree where a wall cuts off a corner in 2D.

    Args:
        grid: The grid.
        boundary: Conditions on the box's faces; faces that are not mentioned are no-slip walls.
        viscosity: Default viscosity eta [Pa s].
        wall: "no_slip" or "no_separation" on the embedded wall.
        poissons_ratio: nu [-], in [0, 0.5).

    Reference: Du et al. 2020, "Functional Optimization of Fluidic Devices with Differentiable
    Stokes Flow"; thesis 4.2.4-4.2.6.
    """

    def __init__(
        self,
        grid: Grid,
        boundary: Boundary | Iterable[Inlet | Open | Wall] = (),
        *,
        viscosity: float = 1.0,
        wall: str = "no_slip",
        poissons_ratio: float = 0.45,
    ):
        super().__init__()
        self.grid = grid
        self.boundary = boundary if isinstance(boundary, Boundary) else Boundary(grid, boundary)
        if self.boundary.grid is not grid:
            raise ValueError("boundary was made for another grid")
        self.viscosity = require_number("viscosity", viscosity, above=0.0)
        self.wall = require_choice("wall", wall, WALL_KINDS)
        nu = require_number(
            "poissons_ratio",
            poissons_ratio,
            at_least=0.0,
            below=0.5,
            hint="for incompressible flow use diffsim.stokes.StokesFlow",
        )
        self.bulk_ratio = 2.0 * nu / (1.0 - 2.0 * nu)
        """lambda / eta [-]."""
        self.tables = CellTables(grid, self.bulk_ratio)

    def forward(
        self,
        phi: Tensor,
        inlet: Tensor | Mapping[str, Tensor] | None = None,
        *,
        viscosity: Tensor | float | None = None,
        wall_velocity: Tensor | None = None,
        body_force: Tensor | None = None,
        traction: Tensor | None = None,
    ) -> FlowField:
        """Solve for the flow; arguments are those of ``StokesFlow.forward``.

        Returns:
            ``FlowField``; ``pressure`` is -lambda times the mean dilatation of a cell's fluid.

        Raises:
            TypeError, ValueError: wrong shapes, NaN, nothing that drives the flow, no fluid, or net
                inflow into a box without an open face.
            FactorizationError: the KKT matrix is singular.
        """
        inputs = flow_inputs(
            self.boundary,
            phi,
            inlet,
            viscosity=self.viscosity if viscosity is None else viscosity,
            wall_velocity=wall_velocity,
            body_force=body_force,
            traction=traction,
        )
        prescribed = inputs.prescribed
        subs, shares, rows = self._geometry(inputs.phi, inputs.wall_velocity, prescribed.shape[0])
        force = torch.zeros_like(prescribed)
        if inputs.body_force.numel():
            force = force + self._volume_force(shares, inputs.body_force)
        if inputs.traction.numel():
            force = force + self._face_force(subs, inputs.traction)
        velocity = KktFunction.apply(
            shares,
            rows.weights,
            rows.values,
            prescribed,
            force * (self.tables.unit / inputs.viscosity),
            rows.cells,
            self.tables,
            self.boundary,
        )
        node_phi = inputs.phi.reshape(self.grid.node_shape)
        field = self._field(node_phi, inputs.viscosity, shares, velocity)
        refuse_net_inflow(float(field.stats["net_inflow"].max()))
        return field.with_imbalance()

    def _volume_force(self, shares: Tensor, body_force: Tensor) -> Tensor:
        """Nodal forces of a force per volume, (cases, num_nodes, dim) [N]."""
        tables = self.tables
        at = tables.at(0.25 + 0.5 * tables.bits)  # (points, corners)
        force = torch.einsum("jc,skci->skji", at, body_force[:, tables.nodes])
        volume = shares * tables.grid.cell_volume
        local = torch.einsum("kj,jc,skji->skci", volume, at, force)
        return tables.assemble(torch.arange(len(shares)), local)

    def _face_force(self, subs: Plane, traction: Tensor) -> Tensor:
        """Nodal forces of a force per area on the fluid part of open faces [N]."""
        tables, grid = self.tables, self.tables.grid
        total = torch.zeros((), dtype=torch.float64)
        index = torch.arange(grid.num_cells).reshape(grid.shape)
        for face in self.boundary.open_faces:
            axis, side = grid.face_axis(face)
            cells = index.select(axis, -side).flatten()
            halves = (tables.bits[:, axis] == side).nonzero()[:, 0]
            slope = subs.slope[cells][:, halves]
            across = torch.zeros(grid.dim, dtype=torch.float64).index_fill(0, torch.tensor(axis), 1)
            # The plane's trace on the face, as a plane of a cell that stands on it.
            trace = Plane(
                slope * (1.0 - across),
                subs.offset[cells][:, halves] + side * (slope @ across),
            )
            area = cut_volume(trace) * (grid.cell_volume / grid.spacing[axis] / len(halves))
            points = 0.25 + 0.5 * tables.bits[halves]
            at = tables.at(points * (1.0 - across) + side * across)
            force = torch.einsum("jc,skci->skji", at, traction[:, tables.nodes[cells]])
            local = torch.einsum("kj,jc,skji->skci", area, at, force)
            total = total + tables.assemble(cells, local)
        return total

    def _geometry(self, phi: Tensor, wall: Tensor, cases: int) -> tuple[Plane, Tensor, _Rows]:
        """Planes and fluid shares of the sub-cells, (num_cells, 2^dim), and the boundary rows."""
        grid, tables = self.boundary.grid, self.tables
        dim, count = grid.dim, 1 << grid.dim
        slope, offset = fit_plane(phi[tables.nodes].reshape(-1, *(2,) * dim))
        origins = 0.5 * tables.bits  # of the sub-cells, (2^dim, dim)
        subs = Plane(
            0.5 * slope[:, None].expand(-1, count, -1), offset[:, None] + slope @ origins.T
        )
        shares = cut_volume(subs) / count
        if not bool((shares.detach().sum(-1) > MIN_SHARE).any()):
            raise ValueError("phi leaves no fluid: it must be > 0 somewhere in the box")
        spacing = torch.tensor(grid.spacing, dtype=torch.float64)
        area = cut_area(subs, [0.5 * h for h in grid.spacing])
        face = grid.cell_volume / max(grid.spacing)
        cells = (area.detach().sum(-1) > MIN_AREA * face).nonzero()[:, 0]
        slope, offset, area = slope[cells], offset[cells], area[cells]
        # Centers of the sub-cells, projected to the plane along its normal in space (eq. 4.73).
        gradient = slope / spacing
        steepest = gradient.square().sum(-1)
        centers = origins + 0.25
        distance = (slope @ centers.T + offset[:, None]) / steepest[:, None]
        points = centers - distance[..., None] * (gradient / spacing)[:, None]
        at_corner = tables.at(points.flatten(0, 1)).reshape(*points.shape[:2], count).mT
        mean = torch.einsum("kcj,kj->kc", at_corner, area / area.sum(-1, keepdim=True))
        if self.wall == "no_slip":
            weights = mean[:, None, :, None] * torch.eye(dim, dtype=torch.float64)[:, None]
        else:
            normal = gradient / steepest.sqrt()[:, None]
            weights = (mean[..., None] * normal[:, None])[:, None]
        if not wall.numel():
            values = weights.new_zeros(cases, len(cells), weights.shape[1])
        else:
            at = wall[:, tables.nodes[cells]].expand(cases, -1, -1, -1)
            values = torch.einsum("krci,skci->skr", weights, at)
        return subs, shares, _Rows(cells, weights, values)

    def _field(self, phi: Tensor, eta: Tensor, shares: Tensor, velocity: Tensor) -> FlowField:
        grid, tables = self.boundary.grid, self.tables
        cases = velocity.shape[0]
        fraction = shares.sum(-1)
        fluid = fraction.detach() > MIN_SHARE
        share = shares / torch.where(fluid, fraction, torch.ones_like(fraction))[:, None]
        local = velocity[:, tables.nodes].flatten(2)  # (cases, cells, corners * dim)
        dilatation = torch.einsum("kj,jn,skn->sk", share, tables.divergence, local)
        dilatation = torch.where(fluid, dilatation, torch.zeros_like(dilatation))
        speed = velocity.detach().norm(dim=-1).amax(1).clamp(min=torch.finfo(torch.float64).tiny)
        mean_square = (fraction * dilatation.square()).sum(-1) / fraction.sum()
        field = FlowField(
            grid=grid,
            phi=phi,
            velocity=velocity.reshape(cases, *grid.node_shape, grid.dim),
            pressure=(-self.bulk_ratio * eta * dilatation).reshape(cases, *grid.shape),
            volume_fraction=fraction.reshape(grid.shape),
            stats={
                "num_iters": velocity.new_zeros(cases),
                "divergence": mean_square.detach().sqrt() / speed * max(grid.size),
                "converged": velocity.new_ones(cases),
            },
        )
        field.stats["net_inflow"] = self._net_inflow(field)
        return field

    def _net_inflow(self, field: FlowField) -> Tensor:
        """Net over gross flux through a box without an open face, else 0; (cases,)."""
        grid = field.grid
        flows = [field.flux(a, -side).detach() * (2 * side - 1) for a, side in _sides(grid.dim)]
        outflow = torch.stack(flows)
        gross = outflow.abs().sum(0)
        if self.boundary.open_faces:
            return torch.zeros_like(gross)
        return outflow.sum(0).abs() / gross.clamp(min=torch.finfo(gross.dtype).tiny)


def _sides(dim: int) -> list[tuple[int, int]]:
    return [(axis, side) for axis in range(dim) for side in (0, 1)]
