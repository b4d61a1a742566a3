"""The published quasi-incompressible formulation of Stokes flow, kept for comparison.

It loses accuracy as Poisson's ratio nears 0.5 (locking) and has a compressibility error below;
``StokesFlow`` has neither. Thesis 4.2.4-4.2.6, Fig. 4-27.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from diffsim._check import require, require_choice, require_number
from diffsim.errors import FactorizationError
from diffsim.stokes.boundary import Boundary, Inlet, Open, Wall
from diffsim.stokes.cut_volume import Plane, cut_area, cut_volume, fit_plane
from diffsim.stokes.field import FlowField
from diffsim.stokes.grid import Grid

WALL_KINDS = ("no_slip", "no_separation")

# Cells with a smaller fluid share carry no energy; walls smaller than this share of a face hold
# nothing (the flow jumps by little as a wall shrinks past it). The authors' code ignores cells with
# a fluid share below 1e-3 together with their walls, and takes those above 1 - 1e-3 for full: the
# same as 0.06 where a wall cuts off a corner in 2D, but it loses walls close to a layer of nodes.
MIN_SHARE = 1e-9
MIN_AREA = 0.06

# Rows of C can repeat each other (a channel with both ends prescribed has one too many). The zero
# block of the KKT matrix gets this diagonal, far below the discretisation error.
SOFTNESS = 1e-10


class _Rows(NamedTuple):
    """Boundary rows C v = d of the cut cells.

    Attributes:
        cells: Flat index of each cut cell, (num_cut,) int64.
        weights: Mean over the wall in the cell, (num_cut, rows, corners, dim) [-]; ``rows`` is dim
            for no slip, 1 for no separation.
        values: d, (cases, num_cut, rows) [m/s].
    """

    cells: Tensor
    weights: Tensor
    values: Tensor


class ThesisFlow(nn.Module):
    """Quasi-incompressible Stokes flow on a grid, as published: for comparison, not for design.

    minimise  sum over sub-cells of volume * (eta |D|^2 + eta nu / (1 - 2 nu) (tr D)^2)
    where     the mean of v over the wall in every cut cell equals the wall's velocity
              ("no_slip"), or only its normal component does ("no_separation")

    Multilinear velocities; each cell is cut by the plane that fits the level set at its corners;
    2^dim quadrature points at the centres of a cell's sub-cells, weighted by exact fluid volumes,
    in full cells too (thesis eqs. 4.67-4.74). The KKT system (4.75) is solved by a sparse LU; its
    factor serves all cases and the adjoint.

    Locks: as nu -> 0.5 the error no longer falls with the cell size; at smaller nu the flow is
    compressible, div v = -p / lambda with lambda = 2 eta nu / (1 - 2 nu). Nodes beyond the wall
    that belong to slivers of fluid only can take large velocities, and since rows hold means,
    velocities that alternate along a wall pass them. Viscosity scales the pressure only.

    Args:
        grid: The grid.
        boundary: Conditions on the box's faces; faces that are not mentioned are no-slip walls.
        viscosity: Default viscosity eta [Pa s].
        poissons_ratio: nu [-], in [0, 0.5).
        wall: "no_slip" or "no_separation" on the embedded wall.

    Gradients: phi, inlet velocities, viscosity, wall velocity; first order. Not modelled beyond
    what ``StokesFlow`` leaves out: body forces and tractions.

    Reference: Du et al. 2020, "Functional Optimization of Fluidic Devices with Differentiable
    Stokes Flow"; thesis 4.2.4-4.2.6.
    """

    def __init__(
        self,
        grid: Grid,
        boundary: Boundary | Iterable[Inlet | Open | Wall] = (),
        *,
        viscosity: float = 1.0,
        poissons_ratio: float = 0.45,
        wall: str = "no_slip",
    ):
        super().__init__()
        self.grid = grid
        self.boundary = boundary if isinstance(boundary, Boundary) else Boundary(grid, boundary)
        if self.boundary.grid is not grid:
            raise ValueError("boundary was made for another grid")
        self.viscosity = require_number("viscosity", viscosity, above=0.0)
        self.poissons_ratio = require_number(
            "poissons_ratio",
            poissons_ratio,
            at_least=0.0,
            below=0.5,
            hint="for incompressible flow use StokesFlow",
        )
        self.wall = require_choice("wall", wall, WALL_KINDS)
        self._cells = _CellTables(grid, self.bulk_ratio)

    @property
    def bulk_ratio(self) -> float:
        """lambda / eta = 2 nu / (1 - 2 nu)."""
        return 2.0 * self.poissons_ratio / (1.0 - 2.0 * self.poissons_ratio)

    def forward(
        self,
        phi: Tensor,
        inlet: Tensor | Mapping[str, Tensor] | None = None,
        *,
        viscosity: Tensor | float | None = None,
        wall_velocity: Tensor | None = None,
    ) -> FlowField:
        """Solve for the flow.

        Args:
            phi: Level set at the nodes, (*node_shape,) float64, > 0 in the fluid.
            inlet: Velocity of every inlet by name [m/s]: (dim,), (num_inlet_nodes, dim) or
                (cases, 1 or num_inlet_nodes, dim); one tensor where there is one inlet.
            viscosity: Scalar tensor or number instead of the module's [Pa s].
            wall_velocity: Of the embedded wall [m/s]: (dim,), (*node_shape, dim) or
                (cases, *node_shape, dim).

        Returns:
            ``FlowField``; ``pressure`` is -lambda times the mean dilatation of a cell's fluid.

        Raises:
            TypeError, ValueError: wrong shapes, NaN, no fluid at all, nothing that drives the flow.
            FactorizationError: the KKT matrix is singular.
        """
        grid = self.grid
        phi = require("phi", phi, grid.node_shape, torch.float64)
        eta = torch.as_tensor(self.viscosity if viscosity is None else viscosity)
        eta = require("viscosity", eta.to(torch.float64).reshape(-1), (1,), torch.float64)
        if float(eta.detach()) <= 0.0:
            raise ValueError(f"viscosity must be above 0, got {float(eta.detach()):g}")
        inlets = self.boundary.inlet_velocities(inlet)
        wall = None
        if wall_velocity is not None:
            wall = self.grid.nodal_vectors("wall_velocity", wall_velocity)
        if not inlets and wall is None:
            raise ValueError("nothing drives the flow: add an Inlet or a wall_velocity")
        counts = {v.shape[0] for v in (*inlets.values(), *([] if wall is None else [wall]))} - {1}
        if len(counts) > 1:
            raise ValueError(f"inlets and wall disagree in the number of cases: {sorted(counts)}")
        cases = counts.pop() if counts else 1
        prescribed = phi.new_zeros(cases, grid.num_nodes, grid.dim)
        for name, value in inlets.items():
            nodes = self.boundary.inlets[name]
            prescribed = prescribed.index_copy(1, nodes, value.expand(cases, len(nodes), grid.dim))
        shares, rows = self._geometry(phi.reshape(-1), wall, cases)
        velocity = _KktFunction.apply(
            shares, rows.weights, rows.values, prescribed, rows.cells, self._cells, self.boundary
        )
        return self._field(phi, eta, shares, velocity)

    def _geometry(self, phi: Tensor, wall: Tensor | None, cases: int) -> tuple[Tensor, _Rows]:
        """Fluid share of every sub-cell, (num_cells, 2^dim), and the boundary rows."""
        grid, tables = self.grid, self._cells
        dim, count = grid.dim, 1 << grid.dim
        slope, offset = fit_plane(phi[tables.nodes].reshape(-1, *(2,) * dim))
        origins = 0.5 * tables.bits  # of the sub-cells, (2^dim, dim)
        subs = Plane(
            0.5 * slope[:, None].expand(-1, count, -1), offset[:, None] + slope @ origins.T
        )
        shares = cut_volume(subs) / count
        if not bool((shares.detach().sum(-1) > MIN_SHARE).any()):
            raise ValueError("no fluid: phi must be above 0 somewhere")
        spacing = torch.tensor(grid.spacing, dtype=torch.float64)
        area = cut_area(subs, [0.5 * h for h in grid.spacing])
        face = grid.cell_volume / max(grid.spacing)
        cells = (area.detach().sum(-1) > MIN_AREA * face).nonzero()[:, 0]
        slope, offset, area = slope[cells], offset[cells], area[cells]
        # Centres of the sub-cells, projected to the plane along its normal in space (eq. 4.73).
        gradient = slope / spacing
        steepest = gradient.square().sum(-1)
        centers = origins + 0.25
        distance = (slope @ centers.T + offset[:, None]) / steepest[:, None]
        points = centers - distance[..., None] * (gradient / spacing)[:, None]
        at_corner = torch.where(
            tables.bits[:, None].bool(), points[:, None], 1.0 - points[:, None]
        ).prod(-1)  # shape functions, (num_cut, corners, points)
        mean = torch.einsum("kcj,kj->kc", at_corner, area / area.sum(-1, keepdim=True))
        if self.wall == "no_slip":
            weights = mean[:, None, :, None] * torch.eye(dim, dtype=torch.float64)[:, None]
        else:
            normal = gradient / steepest.sqrt()[:, None]
            weights = (mean[..., None] * normal[:, None])[:, None]
        if wall is None:
            values = weights.new_zeros(cases, len(cells), weights.shape[1])
        else:
            at = wall[:, tables.nodes[cells]].expand(cases, -1, -1, -1)
            values = torch.einsum("krci,skci->skr", weights, at)
        return shares, _Rows(cells, weights, values)

    def _field(self, phi: Tensor, eta: Tensor, shares: Tensor, velocity: Tensor) -> FlowField:
        grid, tables = self.grid, self._cells
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
        outflow = velocity.new_zeros(cases)
        for face in grid.faces:
            if face not in self.boundary.open_faces:
                axis, side = grid.face_axis(face)
                outflow = outflow + field.flux(axis, -side).detach() * (1.0 if side else -1.0)
        field.stats["net_inflow"] = -outflow
        return field


class _CellTables:
    """What is the same for every cell: corners, sub-cell matrices and dilatations.

    Attributes:
        nodes: Corners of every cell, (num_cells, 2^dim) int64, the last axis fastest.
        bits: Position of the corners in a cell, (2^dim, dim), 0 or 1.
        divergence: Dilatation at the sub-cells' centres, (2^dim points, 2^dim * dim) [1/m].
        stiffness: Energy matrix at each point for eta = 1 and the whole cell's volume, scaled by
            the cell size: (2^dim points, n, n), n = 2^dim * dim [-].
    """

    def __init__(self, grid: Grid, bulk_ratio: float):
        dim, count = grid.dim, 1 << grid.dim
        bits = torch.tensor(list(itertools.product((0, 1), repeat=dim)))
        index = torch.arange(grid.num_nodes).reshape(grid.node_shape)
        corners = [
            index[tuple(slice(int(b), int(b) + n) for b, n in zip(row, grid.shape, strict=True))]
            for row in bits
        ]
        self.nodes = torch.stack([c.flatten() for c in corners], dim=-1)
        self.bits = bits.double()
        points = 0.25 + 0.5 * self.bits
        spacing = torch.tensor(grid.spacing, dtype=torch.float64)
        near = torch.where(bits[None].bool(), points[:, None], 1.0 - points[:, None])
        slopes = torch.empty(count, count, dim, dtype=torch.float64)  # point, corner, axis
        for axis in range(dim):
            others = [a for a in range(dim) if a != axis]
            sign = 2.0 * self.bits[:, axis] - 1.0
            slopes[..., axis] = sign * near[..., others].prod(-1) / spacing[axis]
        # D_pq of corner c's component i: (d_iq N_c,p + d_ip N_c,q) / 2.
        eye = torch.eye(dim, dtype=torch.float64)
        strain = 0.5 * torch.einsum("iq,jcp->jpqci", eye, slopes)
        strain = strain + strain.transpose(1, 2)
        strain = strain.reshape(count, dim * dim, count * dim)
        self.divergence = slopes.reshape(count, count * dim)
        scale = grid.cell_volume / min(grid.spacing) ** (dim - 2)
        self.stiffness = scale * (
            2.0 * strain.transpose(1, 2) @ strain
            + bulk_ratio * self.divergence[:, :, None] * self.divergence[:, None, :]
        )


class _KktFunction(torch.autograd.Function):
    """v = argmin v.K(shares) v / 2 subject to C(weights) v = values and v = prescribed on faces.

    With l the multipliers, y and m the solution of the same symmetric system for the right-hand
    side (dL/dv, 0), and K = sum_kj shares_kj K_j linear in the shares:

        dL/dshares_kj = -y_k . K_j v_k
        dL/dweights_kr = -(m_kr v_k + l_kr y_k)
        dL/dvalues = m
        dL/dprescribed = dL/dv - K y - C^T m      on the prescribed components

    y is zero on prescribed components. Per cell, y_k and v_k are the values at its corners.
    """

    @staticmethod
    def forward(ctx, shares, weights, values, prescribed, cells, tables, boundary):
        system = _KktSystem(shares, weights, cells, tables, boundary)
        velocity, multipliers = system.solve(prescribed, values)
        ctx.save_for_backward(weights, velocity, multipliers, cells)
        ctx.system, ctx.tables = system, tables
        return velocity

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        weights, velocity, multipliers, cells = ctx.saved_tensors
        tables = ctx.tables
        y, m, grad_prescribed = ctx.system.solve_adjoint(grad)
        y_local = y[:, tables.nodes].flatten(2)
        v_local = velocity[:, tables.nodes].flatten(2)
        stressed = torch.einsum("jab,skb->skja", tables.stiffness, v_local)
        grad_shares = -torch.einsum("ska,skja->kj", y_local, stressed)
        y_cut = y_local[:, cells].unflatten(-1, weights.shape[2:])
        v_cut = v_local[:, cells].unflatten(-1, weights.shape[2:])
        grad_weights = -torch.einsum("skr,skci->krci", m, v_cut)
        grad_weights -= torch.einsum("skr,skci->krci", multipliers, y_cut)
        return grad_shares, grad_weights, m, grad_prescribed, None, None, None


class _KktSystem:
    """The factorised KKT matrix of one geometry (thesis eq. 4.75), viscosity 1."""

    def __init__(
        self,
        shares: Tensor,
        weights: Tensor,
        cells: Tensor,
        tables: _CellTables,
        boundary: Boundary,
    ):
        num_nodes, dim = boundary.fixed.shape
        size = num_nodes * dim
        dofs = (tables.nodes[..., None] * dim + torch.arange(dim)).flatten(1).numpy()
        fluid = (shares.sum(-1) > MIN_SHARE).numpy()
        active = np.zeros(size, bool)
        active[dofs[fluid]] = True
        local = torch.einsum("kj,jab->kab", shares, tables.stiffness).numpy()[fluid]
        n = local.shape[-1]
        row = np.repeat(dofs[fluid], n, axis=1).ravel()
        col = np.tile(dofs[fluid], (1, n)).ravel()
        self.K = sparse.csr_matrix((local.ravel(), (row, col)), shape=(size, size))
        count, per_cell = weights.shape[:2]
        row = np.repeat(np.arange(count * per_cell), n)
        col = np.repeat(dofs[cells.numpy()], per_cell, axis=0).ravel()
        C = sparse.csr_matrix((weights.numpy().ravel(), (row, col)), shape=(count * per_cell, size))
        self.C = C @ sparse.diags(active.astype(float))  # nodes without energy rest
        self.free = np.flatnonzero(active & ~boundary.fixed.numpy().ravel())
        self.fixed = boundary.fixed.numpy().ravel()
        self.rows_shape = (count, per_cell)
        self.factor = self._factorize()

    def _factorize(self) -> SuperLU:
        K, C = self.K[self.free][:, self.free], self.C[:, self.free]
        soft = sparse.diags(np.full(C.shape[0], -SOFTNESS))
        tiny = sparse.diags(np.full(K.shape[0], 1e-14 * abs(K.diagonal()).max(initial=1.0)))
        matrix = sparse.bmat([[K + tiny, C.T], [C, soft]], format="csc")
        try:
            return splu(matrix, permc_spec="COLAMD")
        except RuntimeError as error:
            raise FactorizationError(
                f"the KKT matrix of {len(self.free)} velocities and {C.shape[0]} boundary rows is "
                "singular; part of the fluid has no wall, inlet or no-slip face that holds it",
                pivot=-1,  # SuperLU does not say which
                value=0.0,
            ) from error

    def solve(self, prescribed: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities (cases, num_nodes, dim) and multipliers (cases, num_cut, rows)."""
        cases = prescribed.shape[0]
        v = prescribed.reshape(cases, -1).numpy().T.copy()
        v[~self.fixed] = 0.0
        load = -(self.K @ v)[self.free]
        gap = values.reshape(cases, -1).numpy().T - self.C @ v
        x = self.factor.solve(np.concatenate([load, gap]))
        v[self.free] = x[: len(self.free)]
        return self._velocity(v, prescribed), self._rows(x[len(self.free) :])

    def solve_adjoint(self, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Adjoint velocities and multipliers, and the gradient in the prescribed components."""
        cases = grad.shape[0]
        g = grad.reshape(cases, -1).numpy().T
        right = np.concatenate([g[self.free], np.zeros((self.C.shape[0], cases))])
        x = self.factor.solve(right, trans="T")
        y, m = np.zeros_like(g), x[len(self.free) :]
        y[self.free] = x[: len(self.free)]
        grad_prescribed = np.where(self.fixed[:, None], g - self.K @ y - self.C.T @ m, 0.0)
        return self._velocity(y, grad), self._rows(m), self._velocity(grad_prescribed, grad)

    @staticmethod
    def _velocity(v: np.ndarray, like: Tensor) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(v.T)).reshape(like.shape)

    def _rows(self, rows: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(rows.T)).reshape(-1, *self.rows_shape)
