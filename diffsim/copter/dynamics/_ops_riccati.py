"""Lyapunov and Riccati equations as torch custom ops; see ``csrc/kernels/copter/riccati.h``.

Their derivatives are Lyapunov equations again, solved by the same op, so that second derivatives
work too.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from diffsim.copter.dynamics.stabilizability import raise_lyapunov_failure, raise_riccati_failure
from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, make_layer
from diffsim.core.record import Solve, announce, is_recording, verdict

RTOL = 1e-8
"""Largest relative residual of a Riccati equation that counts as solved."""
REPORT = ("solved", "num_iters", "residual", "abscissa")


def _check(name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
    """What the kernels rely on; lqr.py beside it has said it to the user already."""
    if value.dtype != torch.float64 or value.device.type != "cpu" or value.shape != shape:
        raise ValueError(
            f"{name} must be a float64 CPU tensor of shape {shape}, got {value.dtype} on "
            f"{value.device} of shape {tuple(value.shape)}"
        )
    return value.contiguous()


@custom_op("diffsim::lyapunov")
def lyapunov(A: Tensor, Q: Tensor, num_threads: int) -> Tensor:
    """X (B, n, n) of A X + X A' + Q = 0."""
    batch, n, _ = A.shape
    A, Q = _check("A", A, (batch, n, n)), _check("Q", Q, (batch, n, n))
    X = torch.empty(A.shape, dtype=torch.float64)
    solved = torch.empty(batch, dtype=torch.int64)
    core.lyapunov(
        A=A.data_ptr(),
        Q=Q.data_ptr(),
        batch=batch,
        size=n,
        X=X.data_ptr(),
        solved=solved.data_ptr(),
        num_threads=num_threads,
    )
    for index in torch.nonzero(solved == 0).flatten().tolist():
        raise_lyapunov_failure(A[index].numpy(), index if batch > 1 else None)
    return X


@lyapunov.register_fake
def _(A: Tensor, Q: Tensor, num_threads: int) -> Tensor:
    return A.new_empty(A.shape)


def _setup_lyapunov(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(inputs[0], output)
    ctx.num_threads = inputs[2]


# dA X + A dX + dX A' + X dA' + dQ = 0, so with A' S + S A + dL/dX = 0:
#   dL/dQ = S,  dL/dA = S X' + S' X.
def _backward_lyapunov(ctx: Any, grad_X: Tensor) -> tuple[Tensor, Tensor, None]:
    A, X = ctx.saved_tensors
    S = lyapunov_layer(A=A.mT.contiguous(), Q=grad_X.contiguous(), num_threads=ctx.num_threads)
    return S @ X.mT + S.mT @ X, S, None


def _tangent_lyapunov(ctx: Any, dA: Tensor | None, dQ: Tensor | None, _: None) -> Tensor:
    A, X = ctx.saved_tensors
    load = torch.zeros_like(X) if dQ is None else dQ
    if dA is not None:
        load = load + dA @ X + X @ dA.mT
    return lyapunov_layer(A=A, Q=load, num_threads=ctx.num_threads)


lyapunov_layer = make_layer(
    lyapunov, setup=_setup_lyapunov, backward=_backward_lyapunov, tangent=_tangent_lyapunov
)


def care_solve(report: Tensor) -> Solve:
    """Why the Riccati equations of a batch ended, from their REPORT (B, 4)."""
    solved, num_iters, residual, _ = (column.tolist() for column in report.unbind(-1))
    return Solve(
        solver="Riccati equation",
        ended=verdict(solved, residual, num_iters, math.inf),
        residual=tuple(residual),
        tolerance=(RTOL,) * len(residual),
        num_iters=tuple(int(n) for n in num_iters),
        details=dict(zip(REPORT, report.clone().unbind(-1), strict=True)),
    )


@custom_op("diffsim::care")
def care(A: Tensor, G: Tensor, Q: Tensor, num_threads: int) -> tuple[Tensor, Tensor]:
    """The stabilizing P (B, n, n) of A'P + P A - P G P + Q = 0, and REPORT (B, 4)."""
    batch, n, _ = A.shape
    shape = (batch, n, n)
    A, G, Q = _check("A", A, shape), _check("G", G, shape), _check("Q", Q, shape)
    P = torch.empty(A.shape, dtype=torch.float64)
    report = torch.empty(batch, len(REPORT), dtype=torch.float64)
    core.care(
        A=A.data_ptr(),
        G=G.data_ptr(),
        Q=Q.data_ptr(),
        batch=batch,
        size=n,
        P=P.data_ptr(),
        report=report.data_ptr(),
        num_threads=num_threads,
    )
    if is_recording():
        announce(care_solve(report))
    for index in torch.nonzero(report[:, 0] == 0).flatten().tolist():
        raise_riccati_failure(
            A[index].numpy(),
            G[index].numpy(),
            Q[index].numpy(),
            float(report[index, 2]),
            index if batch > 1 else None,
        )
    return P, report


@care.register_fake
def _(A: Tensor, G: Tensor, Q: Tensor, num_threads: int) -> tuple[Tensor, Tensor]:
    return A.new_empty(A.shape), A.new_empty(A.shape[0], len(REPORT))


def _setup_care(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(inputs[0], inputs[1], output[0])
    ctx.mark_non_differentiable(output[1])
    ctx.num_threads = inputs[3]


# With A_c = A - G P the differential is A_c' dP + dP A_c + dA' P + P dA - P dG P + dQ = 0, so with
# A_c S + S A_c' + sym(dL/dP) = 0:  dL/dA = 2 P S,  dL/dG = -P S P,  dL/dQ = S.
def _backward_care(ctx: Any, grad_P: Tensor, _: Any) -> tuple[Tensor, Tensor, Tensor, None]:
    A, G, P = ctx.saved_tensors
    S = lyapunov_layer(A=A - G @ P, Q=0.5 * (grad_P + grad_P.mT), num_threads=ctx.num_threads)
    return 2.0 * P @ S, -P @ S @ P, S, None


def _tangent_care(
    ctx: Any, dA: Tensor | None, dG: Tensor | None, dQ: Tensor | None, _: None
) -> tuple[Tensor, None]:
    A, G, P = ctx.saved_tensors
    load = torch.zeros_like(P) if dQ is None else dQ
    if dA is not None:
        load = load + dA.mT @ P + P @ dA
    if dG is not None:
        load = load - P @ dG @ P
    return lyapunov_layer(A=(A - G @ P).mT, Q=load, num_threads=ctx.num_threads), None


care_layer = make_layer(care, setup=_setup_care, backward=_backward_care, tangent=_tangent_care)
