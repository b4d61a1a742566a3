"""Linear algebra on compiled kernels: sparse Cholesky, singular values of 3x3 matrices."""

from diffsim.linalg.cholesky import SparseCholesky
from diffsim.linalg.svd import polar3, svd3

__all__ = ["SparseCholesky", "polar3", "svd3"]
