"""The linear system of the published formulation, and its adjoint (thesis eqs. 4.75, 4.77)."""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse as sparse
import torch
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor
from torch.autograd.function import once_differentiable

from diffsim.core.errors import FactorizationError
from diffsim.stokes.boundary import Boundary
from diffsim.stokes.grid import Grid

# Cells with a smaller fluid share carry no energy.
MIN_SHARE = 1e-9

# Rows of C can repeat each other (a channel with both ends prescribed has one too many). The zero
# block of the KKT matrix gets this diagonal, far below the discretization error.
SOFTNESS = 1e-10


class CellTables:
    """What is the same for every cell: corners, sub-cell matrices and dilatations.

    Attributes:
        grid: The grid.
        nodes: Corners of every cell, (num_cells, 2^dim) int64, the last axis fastest.
        bits: Position of the corners in a cell, (2^dim, dim), 0 or 1.
        divergence: Dilatation at the sub-cells' centers, (2^dim points, 2^dim * dim) [1/m].
        stiffness: Energy matrix at each point for eta = 1 and the whole cell's volume, scaled by
            the cell size: (2^dim points, n, n), n = 2^dim * dim [-].
        unit: Forces [N] of this energy are those of the flow over eta times this [m^(2-dim)].
    """

    def __init__(self, grid: Grid, bulk_ratio: float):
        dim, count = grid.dim, 1 << grid.dim
        self.grid = grid
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
        self.unit = min(grid.spacing) ** (2 - dim)
        self.stiffness = (grid.cell_volume * self.unit) * (
            2.0 * strain.transpose(1, 2) @ strain
            + bulk_ratio * self.divergence[:, :, None] * self.divergence[:, None, :]
        )

    def at(self, points: Tensor) -> Tensor:
        """Shape functions (points, 2^dim corners) at points (points, dim) of a cell."""
        return torch.where(self.bits.bool(), points[:, None], 1.0 - points[:, None]).prod(-1)

    def assemble(self, cells: Tensor, local: Tensor) -> Tensor:
        """Sum of forces at the corners of cells: (cases, cells, 2^dim, dim) to nodes."""
        cases, dim = local.shape[0], local.shape[-1]
        total = local.new_zeros(cases, self.grid.num_nodes, dim)
        return total.index_add(1, self.nodes[cells].flatten(), local.flatten(1, 2))


class KktFunction(torch.autograd.Function):
    """v = argmin v.K(shares) v / 2 - v.load, C(weights) v = values and v = prescribed on faces.

    With l the multipliers, y and m the solution of the same symmetric system for the right-hand
    side (dL/dv, 0), and K = sum_kj shares_kj K_j linear in the shares:

        dL/dshares_kj = -y_k . K_j v_k
        dL/dweights_kr = -(m_kr v_k + l_kr y_k)
        dL/dvalues = m
        dL/dload = y
        dL/dprescribed = dL/dv - K y - C^T m      on the prescribed components

    y is zero on prescribed components. Per cell, y_k and v_k are the values at its corners.
    """

    @staticmethod
    def forward(ctx, shares, weights, values, prescribed, load, cells, tables, boundary):
        system = KktSystem(shares, weights, cells, tables, boundary)
        velocity, multipliers = system.solve(prescribed, values, load)
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
        return grad_shares, grad_weights, m, grad_prescribed, y, None, None, None


class KktSystem:
    """The factorized KKT matrix of one geometry (thesis eq. 4.75), viscosity 1."""

    def __init__(
        self,
        shares: Tensor,
        weights: Tensor,
        cells: Tensor,
        tables: CellTables,
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

    def solve(self, prescribed: Tensor, values: Tensor, load: Tensor) -> tuple[Tensor, Tensor]:
        """Velocities (cases, num_nodes, dim) and multipliers (cases, num_cut, rows)."""
        cases = prescribed.shape[0]
        v = prescribed.reshape(cases, -1).numpy().T.copy()
        v[~self.fixed] = 0.0
        force = (load.reshape(cases, -1).numpy().T - self.K @ v)[self.free]
        gap = values.reshape(cases, -1).numpy().T - self.C @ v
        x = self.factor.solve(np.concatenate([force, gap]))
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
        return torch.from_numpy(np.ascontiguousarray(rows.T)).reshape(
            rows.shape[1], *self.rows_shape
        )
