"""Sparse direct solver for symmetric positive definite matrices of meshes."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import (
    all_finite,
    require,
    require_choice,
    require_constant,
    require_threads,
)
from diffsim.core.errors import FactorizationError
from diffsim.core.numbers import values_of
from diffsim.core.torch_names import on_constants
from diffsim.core.values import as_array
from diffsim.linalg._ops_cholesky import SparseFactor

if TYPE_CHECKING:
    import scipy.sparse as sp

_NO_GRADIENT = "SparseCholesky has no gradient; build a layer on two solves"
_SYMMETRY_TOLERANCE = 1e-12  # relative to the largest entry: assembly in two orders rounds apart


class SparseCholesky:
    """Cholesky factorization A = L L' of a sparse symmetric positive definite matrix.

    The pattern is analyzed once (nested dissection, supernodes); ``refactor`` takes new values on
    the same pattern and ``solve`` any number of right-hand sides. Results do not depend on the
    number of threads. Not modeled: indefinite or unsymmetric matrices, gradients through ``solve``
    (build a layer on two solves). Calls of one object from several Python threads wait for each
    other.

    Args:
        matrix: A, (n, n), scipy sparse matrix or torch sparse CSR tensor, float64; both triangles
            are stored.
        coords: Positions of the mesh nodes, (n / block, 3) float64 tensor or array [any unit].
            Better and faster ordering than from the graph alone; None: from the graph alone.
        block: Unknowns per node, 1 to 6; unknown ``i`` belongs to node ``i // block``. Blocks that
            hold a nonzero are stored in full.
        precision: "float64", or "float32" to compute and store L so, at half the time and memory:
            relative errors of about 1e-6 times the condition number, for preconditioners. Where
            single precision breaks down, float64 computes what float32 stores.
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
        self.num_threads = require_threads(num_threads)
        self.precision = require_choice("precision", precision, ["float64", "float32"])
        csr = _to_scipy(matrix)
        if csr.ndim != 2 or csr.shape[0] != csr.shape[1]:
            raise ValueError(f"matrix must be square, got shape {csr.shape}")
        if csr.shape[0] % block:
            raise ValueError(
                f"matrix must have a multiple of block = {block} rows, got {csr.shape[0]}"
            )
        self.shape = csr.shape
        self._pattern = _Pattern(csr, block)
        self._check_values(csr)
        if coords is not None:
            require_constant("coords", coords, "they order unknowns")
            coords = as_array("coords", coords)
            coords = values_of(require("coords", coords, (self.shape[0] // block, 3)))
        with on_constants():
            self._factor = SparseFactor(
                torch.as_tensor(self._pattern.indptr),
                torch.as_tensor(self._pattern.indices),
                coords,
                block,
                self.precision == "float32",
            )
        self._lock = threading.Lock()  # the factor has one workspace
        self._refactor(csr)

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
        """Floating-point operations of one factorization."""
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
        csr = _to_scipy(matrix)
        if csr.shape != self.shape:
            raise ValueError(f"matrix must have shape {self.shape}, got {csr.shape}")
        if not self._pattern.matches(csr):
            raise ValueError(
                "matrix must have the sparsity pattern it was analyzed with "
                f"({len(self._pattern.columns)} entries), got another one ({csr.nnz} entries); "
                "store explicit zeros to keep a pattern, or make a new SparseCholesky"
            )
        self._check_values(csr)
        self._refactor(csr)

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
            FactorizationError: the last ``refactor`` failed, or x has no room in float64.
        """
        require_constant("b", b, _NO_GRADIENT)
        tensor = torch.as_tensor(b) if isinstance(b, np.ndarray) else b
        ndim = getattr(tensor, "ndim", 1)
        shape = (self.shape[0],) if ndim == 1 else (self.shape[0], "k")
        tensor = values_of(require("b", tensor, shape))
        with self._lock, on_constants():
            self._require_usable()
            columns = tensor if ndim == 2 else tensor.unsqueeze(1)
            x = self._factor.solve(columns, self.num_threads)
        if not all_finite(x):
            raise FactorizationError(
                "the solution is beyond what float64 holds: entries of the matrix are too small "
                "for these right-hand sides; choose units in which both are near one",
                pivot=-1,
                value=float("nan"),
            )
        x = x if ndim == 2 else x.squeeze(1)
        return x.numpy() if isinstance(b, np.ndarray) else x

    def _require_usable(self) -> None:
        if not self._factor.usable:
            raise FactorizationError(
                "the last refactor failed, so there is no factor to solve with; "
                "refactor with a positive definite matrix first",
                pivot=-1,
                value=float("nan"),
            )

    def _check_values(self, csr: sp.csr_matrix) -> None:
        if not np.isfinite(csr.data).all():
            bad = int(np.flatnonzero(~np.isfinite(csr.data))[0])
            row, column = int(self._pattern.rows[bad]), int(csr.indices[bad])
            raise ValueError(f"matrix must be finite, got {csr.data[bad]} at ({row}, {column})")
        self._pattern.require_symmetric(csr.data)

    @on_constants()
    def _refactor(self, csr: sp.csr_matrix) -> None:
        values = torch.as_tensor(self._pattern.blocks(csr.data))
        with self._lock:
            unknown, pivot = self._factor.refactor(values, self.num_threads)
        if unknown >= 0:
            raise FactorizationError(
                f"matrix must be positive definite, got pivot {pivot:.3g} at unknown {unknown} "
                f"(node {unknown // self.block}); fix a rigid motion (Dirichlet condition), add "
                "mass or a shift to the diagonal, or use a solver for indefinite matrices",
                pivot=unknown,
                value=pivot,
            )


class _Pattern:
    """A scalar CSR pattern and where its entries go in blocks with every diagonal block stored."""

    def __init__(self, csr: sp.csr_matrix, block: int):
        self.block = block
        self.shape = csr.shape
        self.row_begin, self.columns = csr.indptr, csr.indices
        num_rows, num_nodes = csr.shape[0], csr.shape[0] // block
        rows = np.repeat(np.arange(num_rows), np.diff(csr.indptr))
        columns = csr.indices.astype(np.int64)
        # The transposed entry of every entry, where the pattern is symmetric.
        key, transposed = rows * num_rows + columns, columns * num_rows + rows
        where = np.minimum(np.searchsorted(key, transposed), max(len(key) - 1, 0))
        lonely = np.flatnonzero(key[where] != transposed) if len(key) else where
        self.transposed = where
        self.lonely = lonely  # entries whose transposed entry is not stored, and counts as zero
        self.rows = rows
        node = np.arange(num_nodes)
        i, j = rows // block, columns // block
        keys = np.unique(
            np.concatenate([i, j, node]) * num_nodes + np.concatenate([j, i, node])
        ).astype(np.int64)
        self.num_blocks = len(keys)
        self.indptr = np.searchsorted(keys, np.arange(num_nodes + 1) * num_nodes).astype(np.int64)
        self.indices = keys % max(num_nodes, 1)
        entry = np.searchsorted(keys, i * num_nodes + j)
        self.target = (entry * block + rows % block) * block + columns % block

    def matches(self, csr: sp.csr_matrix) -> bool:
        return np.array_equal(csr.indptr, self.row_begin) and np.array_equal(
            csr.indices, self.columns
        )

    def require_symmetric(self, data: np.ndarray) -> None:
        if not len(data):
            return
        mirrored = data[self.transposed]
        mirrored[self.lonely] = 0.0
        difference = np.abs(data - mirrored)
        worst = int(np.argmax(difference))
        if difference[worst] > _SYMMETRY_TOLERANCE * np.abs(data).max():
            i, j = int(self.rows[worst]), int(self.columns[worst])
            raise ValueError(
                f"matrix must be symmetric, got A[{i}, {j}] = {data[worst]:g} and A[{j}, {i}] = "
                f"{mirrored[worst]:g}; store both triangles, for rounding use (A + A.T) / 2"
            )

    def blocks(self, data: np.ndarray) -> np.ndarray:
        values = np.zeros((self.num_blocks, self.block, self.block))
        values.reshape(-1)[self.target] = data
        return values


def _to_scipy(matrix: sp.spmatrix | sp.sparray | Tensor) -> sp.csr_matrix:
    import scipy.sparse as sp

    if isinstance(matrix, Tensor):
        if matrix.layout != torch.sparse_csr:
            raise TypeError(
                f"matrix must be a torch sparse CSR tensor, got layout {matrix.layout}; "
                "convert with matrix.to_sparse_csr()"
            )
        if matrix.device.type != "cpu":
            raise TypeError(f"matrix must be on the CPU, got device {matrix.device}")
        require_constant("matrix", matrix, _NO_GRADIENT)
        with on_constants():
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
