"""Thin door to the compiled linear algebra: passes addresses of arrays already checked."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core


class SparseFactor:
    """Sparse Cholesky factor of a fixed pattern; see ``csrc/kernels/linalg/cholesky.h``.

    Args:
        indptr: CSR row starts, (num_nodes + 1,) int64, contiguous.
        indices: CSR columns with the diagonal, (nnz,) int64, contiguous.
        coords: Node positions, (num_nodes, 3) float64, contiguous, or None.
        block: Unknowns per node.
        single: Compute and store the factor in float32.
    """

    def __init__(
        self, indptr: Tensor, indices: Tensor, coords: Tensor | None, block: int, single: bool
    ):
        address = 0 if coords is None else coords.data_ptr()
        self._core = core.SparseFactor(
            indptr.numel() - 1, indptr.data_ptr(), indices.data_ptr(), address, block, single
        )

    def refactor(self, values: Tensor, num_threads: int) -> tuple[int, float]:
        """Factor (nnz, block, block) values; returns the failed (unknown, pivot) or (-1, 0)."""
        return self._core.refactor(values.data_ptr(), num_threads)

    def solve(self, b: Tensor, num_threads: int) -> Tensor:
        """A^-1 b for b of shape (num_unknowns, num_rhs), contiguous."""
        x = torch.empty_like(b)
        self._core.solve(b.data_ptr(), x.data_ptr(), b.shape[1], num_threads)
        return x

    def inverse_among(self, among: Tensor, num_threads: int) -> Tensor:
        """Rows and columns of A^-1 at unknowns (count,) int64, (count, count)."""
        inverse = torch.empty(len(among), len(among), dtype=torch.float64)
        self._core.inverse_among(among.data_ptr(), len(among), inverse.data_ptr(), num_threads)
        return inverse

    @property
    def usable(self) -> bool:
        return self._core.usable

    @property
    def nnz(self) -> int:
        return self._core.nnz

    @property
    def bytes(self) -> int:
        return self._core.bytes

    @property
    def flops(self) -> float:
        return self._core.flops
