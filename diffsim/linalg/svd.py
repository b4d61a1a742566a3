"""Singular value and polar decompositions of 3x3 matrices, with proper rotations."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.check import require, require_threads
from diffsim.linalg import _ops_svd


def svd3(F: Tensor, *, num_threads: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Singular value decomposition of 3x3 matrices with proper rotations.

    F = U diag(s) V^T,  det U = det V = +1,  s0 >= s1 >= abs(s2),  sign(s2) = sign(det F).

    The sign sits on the last singular value, not on U or V: an inverted element has s2 < 0, and s
    is smooth through det F = 0. Two columns of U and the same two of V may change sign together,
    and no canonical choice is made: losses should not depend on it.

    Errors of U diag(s) V^T and of s are about 1e-15 s0 at any condition number and any scale;
    values below that, relative to s0, are noise. A matrix that holds NaN or infinity gives NaN
    throughout.

    Args:
        F: Matrices, (..., 3, 3) float64; any unit.
        num_threads: Threads of the kernel; the result does not depend on it.

    Returns:
        U (..., 3, 3) [-], s (..., 3) in the unit of F, V (..., 3, 3) [-].

    Raises:
        TypeError: F is not a float64 CPU tensor.
        ValueError: F is not (..., 3, 3), or num_threads out of range.

    Gradients: F, first order. U and V have no derivative where two of s0, s1, abs(s2) agree (to
    1e-15 s0): there the gradient of F is NaN if the loss feels the rotation of that pair, that is,
    unless dL/dU and dL/dV have exactly no part in it. A loss of s alone has a finite gradient
    everywhere, U diag(dL/ds) V^T; at repeated values it is right for losses symmetric in them.
    For the rotation U V^T use ``polar3``, which repeated values do not trouble.
    """
    F, num_threads = _check_matrices(F, num_threads)
    return _ops_svd.svd3(F, num_threads)


def polar3(F: Tensor, *, num_threads: int = 1) -> Tensor:
    """The rotation nearest to each 3x3 matrix: R of F = R H, H symmetric, det R = +1.

    R = U V^T with the proper rotations of ``svd3``; for det F < 0, H has one negative eigenvalue.
    Not unique where s1 + s2 = 0 (reflections with s1 = -s2, rank one and zero): some nearest
    rotation is returned. A matrix that holds NaN or infinity gives NaN throughout.

    Args:
        F: Matrices, (..., 3, 3) float64; any unit.
        num_threads: Threads of the kernel; the result does not depend on it.

    Returns:
        R (..., 3, 3) [-].

    Raises:
        TypeError: F is not a float64 CPU tensor.
        ValueError: F is not (..., 3, 3), or num_threads < 1.

    Gradients: F, first order, also at repeated singular values (it depends on s_i + s_j only) and
    for inverted matrices. It grows as 1 / (s1 + s2) and is NaN where s1 + s2 = 0 (to 1e-15 s0),
    unless dL/dR has exactly no part that turns R.
    """
    F, num_threads = _check_matrices(F, num_threads)
    return _ops_svd.polar3(F, num_threads)


def _check_matrices(F: Tensor, num_threads: int) -> tuple[Tensor, int]:
    F = require("F", F, ("...", 3, 3), torch.float64, finite=False)
    return F, require_threads(num_threads)
