"""Sparse direct solver for symmetric positive definite matrices of meshes."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor

from diffsim._check import require, require_choice
from diffsim._ops_linalg import SparseFactor
from diffsim.errors import FactorizationError

_SYMMETRY_TOLERANCE = 1e-12  # relative to the largest entry: assembly in two orders rounds apart


class SparseCholesky:
    """Cholesky factorisation A = L L' of a sparse symmetric positive definite matrix.

    The pattern is analysed once (nested dissection, supernodes); ``refactor`` takes new values on
    the same pattern and ``solve`` any number of right-hand sides. Results do not depend on the
    number of threads. Not modelled: indefinite or unsymmetric matrices, gradients through ``solve``
    (build a layer on two solves). Solves of one object from several threads at once are not safe.

    Args:
        matrix: A, (n, n), scipy sparse matrix or torch sparse CSR tensor, float64; both triangles
            are stored.
        coords: Positions of the mesh nodes, (n / block, 3) float64 tensor or array [any unit].
            Better and faster ordering than from the graph alone; None: from the graph alone.
        block: Unknowns per node, 1 to 6; unknown ``i`` belongs to node ``i // block``. Blocks that
            hold a nonzero are stored in full.
        precision: "float64", or "float32" to store L at half the memory, which gives solutions
            with relative errors of about 1e-6 times the condition number: for preconditioners.
        num_threads: Worker threads of every call.

    Raises:
        TypeError: the matrix is no sparse matrix, or has the wrong dtype.
        ValueError: A is not square, not symmetric, not finite, or sizes disagree.
        FactorizationError: A is singular or indefinite; carries ``pivot`` and ``value``.

    Example:
        >>> factor = SparseCholesky(stiffness, coords=mesh.x, block=3)
        >>> x = factor.solve(force)
    """

    def __init__(
        self,
        matrix: sp.spmatrix | sp.sparray | Tensor,
        coords: Tensor | np.ndarray | None = None,
        *,
        block: int = 1,
        precision: str = "float64",
        num_threads: int = 1,
    ):
        if isinstance(block, bool) or not isinstance(block, int) or not 1 <= block <= 6:
            raise ValueError(f"block must be an integer from 1 to 6, got {block!r}")
        self.block = block
        self.num_threads = _require_threads(num_threads)
        self.precision = require_choice("precision", precision, ["float64", "float32"])
        blocks = self._blocks(matrix)
        self._indptr = torch.as_tensor(blocks.indptr.astype(np.int64))
        self._indices = torch.as_tensor(blocks.indices.astype(np.int64))
        self.shape = blocks.shape
        if coords is not None:
            coords = torch.as_tensor(coords)
            coords = require("coords", coords, (self.shape[0] // block, 3), torch.float64)
        self._factor = SparseFactor(
            self._indptr, self._indices, coords, block, self.precision == "float32"
        )
        self._refactor(blocks)

    @property
    def nnz(self) -> int:
        """Entries of L, the zeros that relaxed supernodes add included."""
        return self._factor.nnz

    @property
    def num_bytes(self) -> int:
        """Memory of L as stored; a solve reads it twice [byte]."""
        return self._factor.bytes

    @property
    def flops(self) -> float:
        """Floating-point operations of one factorisation."""
        return self._factor.flops

    def refactor(self, matrix: sp.spmatrix | sp.sparray | Tensor) -> None:
        """Factor new values on the pattern given at construction.

        Args:
            matrix: A, (n, n) as in the constructor, with the same pattern.

        Raises:
            ValueError: the shape or the pattern differs, or as in the constructor.
            FactorizationError: A is singular or indefinite; ``solve`` then refuses until the next
                successful ``refactor``.
        """
        blocks = self._blocks(matrix)
        if blocks.shape != self.shape:
            raise ValueError(f"matrix must have shape {self.shape}, got {blocks.shape}")
        if not (
            np.array_equal(blocks.indptr, self._indptr)
            and np.array_equal(blocks.indices, self._indices)
        ):
            raise ValueError(
                "matrix must have the sparsity pattern it was analysed with "
                f"({len(self._indices)} blocks), got another one ({len(blocks.indices)} blocks); "
                "store explicit zeros to keep a pattern, or make a new SparseCholesky"
            )
        self._refactor(blocks)

    def solve(self, b: Tensor | np.ndarray) -> Tensor | np.ndarray:
        """Solve A x = b.

        Args:
            b: Right-hand sides, (n,) or (n, k) float64 tensor or array; k = 3 (or a multiple) is
                the fastest per right-hand side.

        Returns:
            x, of the shape and kind of ``b``.

        Raises:
            TypeError: ``b`` is not float64.
            ValueError: wrong shape, or not finite.
            FactorizationError: the last ``refactor`` failed.
        """
        if isinstance(b, Tensor) and b.requires_grad:
            raise ValueError("b must not require grad: SparseCholesky.solve has no gradient")
        tensor = torch.as_tensor(b) if isinstance(b, np.ndarray) else b
        ndim = getattr(tensor, "ndim", 1)
        shape = (self.shape[0],) if ndim == 1 else (self.shape[0], "k")
        tensor = require("b", tensor, shape)
        if not self._factor.usable:
            raise FactorizationError(
                "the last refactor failed, so there is no factor to solve with; "
                "refactor with a positive definite matrix first",
                pivot=-1,
                value=float("nan"),
            )
        columns = tensor if ndim == 2 else tensor.unsqueeze(1)
        x = self._factor.solve(columns, self.num_threads)
        x = x if ndim == 2 else x.squeeze(1)
        return x.numpy() if isinstance(b, np.ndarray) else x

    def _refactor(self, blocks: sp.bsr_matrix) -> None:
        values = torch.as_tensor(np.ascontiguousarray(blocks.data))
        unknown, pivot = self._factor.refactor(values, self.num_threads)
        if unknown >= 0:
            raise FactorizationError(
                f"matrix must be positive definite, got pivot {pivot:.3g} at unknown {unknown} "
                f"(node {unknown // self.block}); fix a rigid motion (Dirichlet condition), add "
                "mass or a shift to the diagonal, or use a solver for indefinite matrices",
                pivot=unknown,
                value=pivot,
            )

    def _blocks(self, matrix: sp.spmatrix | sp.sparray | Tensor) -> sp.bsr_matrix:
        """The matrix as checked blocks with sorted columns and every diagonal block stored."""
        csr = _to_scipy(matrix)
        if csr.ndim != 2 or csr.shape[0] != csr.shape[1]:
            raise ValueError(f"matrix must be square, got shape {csr.shape}")
        if csr.shape[0] % self.block:
            raise ValueError(
                f"matrix must have a multiple of block = {self.block} rows, got {csr.shape[0]}"
            )
        if not np.isfinite(csr.data).all():
            bad = int(np.flatnonzero(~np.isfinite(csr.data))[0])
            row = int(np.searchsorted(csr.indptr, bad, side="right")) - 1
            raise ValueError(
                f"matrix must be finite, got {csr.data[bad]} at ({row}, {int(csr.indices[bad])})"
            )
        _require_symmetric(csr)
        return _block_pattern(csr, self.block)


def _to_scipy(matrix: sp.spmatrix | sp.sparray | Tensor) -> sp.csr_matrix:
    if isinstance(matrix, Tensor):
        if matrix.layout != torch.sparse_csr:
            raise TypeError(
                f"matrix must be a torch sparse CSR tensor, got layout {matrix.layout}; "
                "convert with matrix.to_sparse_csr()"
            )
        if matrix.device.type != "cpu":
            raise TypeError(f"matrix must be on the CPU, got device {matrix.device}")
        matrix = matrix.detach()
        parts = (matrix.values(), matrix.col_indices(), matrix.crow_indices())
        matrix = sp.csr_matrix(tuple(p.numpy() for p in parts), shape=tuple(matrix.shape))
    if not sp.issparse(matrix):
        raise TypeError(
            f"matrix must be a scipy sparse matrix or a torch sparse CSR tensor, "
            f"got {type(matrix).__name__}; convert with scipy.sparse.csr_matrix(matrix)"
        )
    if matrix.dtype != np.float64:
        raise TypeError(
            f"matrix must be float64, got {matrix.dtype}; convert with matrix.astype(float)"
        )
    csr = sp.csr_matrix(matrix, copy=True)
    csr.sum_duplicates()
    return csr


def _require_symmetric(csr: sp.csr_matrix) -> None:
    if csr.nnz == 0:
        return
    difference = abs(csr - csr.T).tocoo()
    if difference.nnz == 0:
        return
    worst = int(np.argmax(difference.data))
    if difference.data[worst] > _SYMMETRY_TOLERANCE * abs(csr.data).max():
        i, j = int(difference.row[worst]), int(difference.col[worst])
        raise ValueError(
            f"matrix must be symmetric, got A[{i}, {j}] = {csr[i, j]:g} and "
            f"A[{j}, {i}] = {csr[j, i]:g}; store both triangles, for rounding use (A + A.T) / 2"
        )


def _block_pattern(csr: sp.csr_matrix, block: int) -> sp.bsr_matrix:
    """Blocks on the symmetrised pattern of ``csr`` with the whole diagonal, zeros kept."""
    num_nodes = csr.shape[0] // block
    rows = np.repeat(np.arange(csr.shape[0]), np.diff(csr.indptr))
    i, j = rows // block, csr.indices // block
    node = np.arange(num_nodes)
    keys = np.concatenate([i, j, node]) * np.int64(num_nodes) + np.concatenate([j, i, node])
    keys = np.unique(keys)
    indptr = np.searchsorted(keys, np.arange(num_nodes + 1) * np.int64(num_nodes))
    data = np.zeros((len(keys), block, block))
    where = np.searchsorted(keys, i * np.int64(num_nodes) + j)
    data[where, rows % block, csr.indices % block] = csr.data
    indices = keys % np.int64(max(num_nodes, 1))
    return sp.bsr_matrix((data, indices, indptr), shape=csr.shape, blocksize=(block, block))


def _require_threads(num_threads: int) -> int:
    if isinstance(num_threads, bool) or not isinstance(num_threads, int) or num_threads < 1:
        raise ValueError(f"num_threads must be an integer >= 1, got {num_threads!r}")
    return num_threads
