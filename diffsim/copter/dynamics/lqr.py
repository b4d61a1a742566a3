"""Linear-quadratic regulator and Lyapunov equation as differentiable layers (thesis 3.3.3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.copter.dynamics import _ops_riccati
from diffsim.core.check import (
    require,
    require_constant,
    require_constants,
    require_range,
    require_threads,
)
from diffsim.core.checked import checked
from diffsim.core.module import Float64Module, loadable
from diffsim.core.numbers import values_of
from diffsim.core.record import Solve

_SYMMETRY = 1e-9  # relative to the largest entry: products in two orders round apart
_SEMIDEFINITE = 1e-10  # eigenvalue below zero, relative to the largest, that is rounding


@loadable
class LqrGain(NamedTuple):
    """Gain and cost of the regulator.

    Attributes:
        K: u = -K x, (..., m, n).
        P: The cost of starting at x is x' P x, (..., n, n).
    """

    K: Tensor
    P: Tensor


class LqrStats(NamedTuple):
    """How well the Riccati equation was solved; no gradients.

    Attributes:
        num_iters: Doublings, (...).
        residual: |A'P + PA - PGP + Q| over the sum of the norms of its terms, (...).
        abscissa: Largest real part of a closed-loop eigenvalue, (...) [1/s], < 0.
        solve: Why every equation of the batch ended.
    """

    num_iters: Tensor
    residual: Tensor
    abscissa: Tensor
    solve: Solve


def lyapunov(A: Tensor, Q: Tensor, *, num_threads: int = 1) -> Tensor:
    """Solve A X + X A' + Q = 0.

    Args:
        A: (..., n, n) float64 [1/s]; no two eigenvalues may add up to zero (stable: always so).
        Q: (..., n, n) float64, symmetric or not.
        num_threads: Threads over the batch; the result does not depend on it.

    Returns:
        X, (..., n, n), symmetric where Q is.

    Raises:
        TypeError, ValueError: wrong type or shape, not finite.
        RiccatiError: no unique solution.

    Gradients: A, Q; any order.
    """
    num_threads = require_threads(num_threads)
    A = require("A", A, ("...", "n", "n"))
    n = A.shape[-1]
    _require_square("A", A)
    Q = require("Q", Q, ("...", n, n))
    batch = torch.Size(np.broadcast_shapes(A.shape[:-2], Q.shape[:-2]))
    X = _ops_riccati.lyapunov(A=_flat(A, batch), Q=_flat(Q, batch), num_threads=num_threads)
    return X.reshape(*batch, n, n)


@checked
def lqr(A: Tensor, B: Tensor, Q: Tensor, R: Tensor, *, num_threads: int = 1) -> LqrGain:
    """The gain that minimizes the integral of x' Q x + u' R u along x' = A x + B u.

    u = -K x, K = R^-1 B' P, with the stabilizing solution of
    A'P + P A - P B R^-1 B' P + Q = 0 (thesis 3.3.3).

    Args:
        A: State matrix, (..., n, n) float64 [1/s].
        B: (..., n, m) float64.
        Q: State weights, (..., n, n) float64, symmetric positive semidefinite.
        R: Input weights, (..., m, m) float64, symmetric positive definite.
        num_threads: Threads over the batch; the result does not depend on it.

    Returns:
        K (..., m, n) and P (..., n, n); batch axes broadcast.

    Raises:
        TypeError, ValueError: wrong type or shape, not finite, not symmetric; Q not positive
            semidefinite, R not positive definite (under ``torch.compile`` only the solve checks).
        RiccatiError: (A, B) is not stabilizable (names the mode), a mode that does not decay is
            invisible to Q, or the equation was not solved.

    Gradients: A, B, Q, R (of their symmetric parts); any order.
    """
    A, B, Q, R = _require_problem(A, B, Q, R)
    num_threads = require_threads(num_threads)
    P, _ = _solve(A, B, Q, R, num_threads)
    return LqrGain(torch.linalg.solve(R, B.mT @ P), P)


@checked
def lqr_stats(A: Tensor, B: Tensor, Q: Tensor, R: Tensor) -> LqrStats:
    """What the solver reports on the Riccati equation of ``lqr``; tracked arguments are refused."""
    require_constants("reports have no gradient", A=A, B=B, Q=Q, R=R)
    with torch.no_grad():
        A, B, Q, R = _require_problem(A, B, Q, R)
        _, report = _solve(A, B, Q, R, 1)
    return LqrStats(
        report[..., 1].to(torch.int64),
        report[..., 2],
        report[..., 3],
        _ops_riccati.care_solve(report.reshape(-1, len(_ops_riccati.REPORT))),
    )


class LQR(Float64Module):
    """``lqr`` with trainable diagonal weights, positive through their logarithms.

    Args:
        q: Diagonal of Q at the start, (n,) > 0.
        r: Diagonal of R at the start, (m,) > 0.
        trainable: False: the weights stay as they are.
    """

    def __init__(self, q: Tensor, r: Tensor, *, trainable: bool = True):
        super().__init__()
        for name, value in (("q", q), ("r", r)):
            require_constant(name, value, "it is a first guess of parameters")
            require(name, value, (name.upper(),))
            require_range(name, value, above=0.0)
        self.log_q = nn.Parameter(q.detach().log(), requires_grad=trainable)
        self.log_r = nn.Parameter(r.detach().log(), requires_grad=trainable)

    def forward(self, A: Tensor, B: Tensor) -> LqrGain:
        """Gain and cost of x' = A x + B u, A (..., n, n), B (..., n, m)."""
        return lqr(A, B, torch.diag(self.log_q.exp()), torch.diag(self.log_r.exp()))


def _solve(A: Tensor, B: Tensor, Q: Tensor, R: Tensor, num_threads: int) -> tuple[Tensor, Tensor]:
    G = B @ torch.linalg.solve(R, B.mT)
    G = 0.5 * (G + G.mT)
    batch = torch.Size(np.broadcast_shapes(A.shape[:-2], G.shape[:-2], Q.shape[:-2]))
    P, report = _ops_riccati.care(
        A=_flat(A, batch), G=_flat(G, batch), Q=_flat(Q, batch), num_threads=num_threads
    )
    return P.reshape(*batch, *A.shape[-2:]), report.reshape(*batch, -1)


def _flat(matrix: Tensor, batch: torch.Size) -> Tensor:
    n = matrix.shape[-1]
    return matrix.expand(*batch, n, n).reshape(batch.numel(), n, n)


def _require_square(name: str, matrix: Tensor) -> None:
    if matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"{name} must be square, got shape {tuple(matrix.shape)}")


def _require_problem(A: Tensor, B: Tensor, Q: Tensor, R: Tensor) -> tuple[Tensor, ...]:
    A = require("A", A, ("...", "n", "n"))
    _require_square("A", A)
    B = require("B", B, ("...", A.shape[-1], "m"))
    Q = require("Q", Q, ("...", A.shape[-1], A.shape[-1]))
    R = require("R", R, ("...", B.shape[-1], B.shape[-1]))
    if not torch.compiler.is_compiling():
        _require_definite("Q", Q.detach(), strictly=False)
        _require_definite("R", R.detach(), strictly=True)
    return A, B, 0.5 * (Q + Q.mT), 0.5 * (R + R.mT)


def _require_definite(name: str, matrix: Tensor, *, strictly: bool) -> None:
    matrix = values_of(matrix)
    if matrix.numel() == 0:
        return
    largest = float(matrix.abs().max())
    skew = float((matrix - matrix.mT).abs().max())
    if skew > _SYMMETRY * largest:
        raise ValueError(
            f"{name} must be symmetric, got asymmetry {skew:g}; use ({name} + {name}.mT) / 2"
        )
    least = float(torch.linalg.eigvalsh(0.5 * (matrix + matrix.mT)).min())
    if strictly and not least > 0.0:
        raise ValueError(
            f"{name} must be positive definite, got smallest eigenvalue {least:g}; every input "
            "needs a weight above 0"
        )
    if least < -_SEMIDEFINITE * largest:
        raise ValueError(f"{name} must be positive semidefinite, got smallest eigenvalue {least:g}")
