"""Lyapunov and Riccati equations as torch custom ops; see ``csrc/kernels/copter/riccati.h``.

Their derivatives are Lyapunov equations again, solved by the same op, so that second derivatives
work too.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from diffsim.copter.dynamics.stabilizability import raise_lyapunov_failure, raise_riccati_failure
from diffsim.core.compiled import core
from diffsim.core.ops import Call, Given, Op, array
from diffsim.core.record import Solve, announce, is_recording, verdict

RTOL = 1e-8
"""Largest relative residual of a Riccati equation that counts as solved."""
REPORT = ("solved", "num_iters", "residual", "abscissa")


SQUARE = array("batch", "size", "size")


def _lyapunov(call: Call) -> None:
    solved = torch.empty(len(call["A"]), dtype=torch.int64)
    core.lyapunov(**call.addresses(), **call.sizes, solved=solved.data_ptr())
    for index in torch.nonzero(solved == 0).flatten().tolist():
        raise_lyapunov_failure(call["A"][index].numpy(), index if len(solved) > 1 else None)


# dA X + A dX + dX A' + X dA' + dQ = 0, so with A' S + S A + dL/dX = 0:
#   dL/dQ = S,  dL/dA = S X' + S' X.
def _lyapunov_gradients(given: Given, grads: Given) -> dict[str, Tensor]:
    X = given["X"]
    S = lyapunov(given["A"].mT, grads["X"], given["num_threads"])
    return {"A": S @ X.mT + S.mT @ X, "Q": S}


def _lyapunov_directions(given: Given, moved: Given) -> dict[str, Tensor]:
    X = given["X"]
    load = moved.get("Q", torch.zeros_like(X))
    if "A" in moved:
        load = load + moved["A"] @ X + X @ moved["A"].mT
    return {"X": lyapunov(given["A"], load, given["num_threads"])}


lyapunov = Op(  # X of A X + X A' + Q = 0
    "lyapunov",
    inputs={"A": SQUARE, "Q": SQUARE},
    outputs={"X": SQUARE},
    options="int num_threads",
    reads=("A", "X"),
    kernel=_lyapunov,
    backward=_lyapunov_gradients,
    forward=_lyapunov_directions,
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


def _care(call: Call) -> None:
    core.care(**call.addresses(), **call.sizes)
    report = call["report"]
    if is_recording():
        announce(care_solve(report))
    for index in torch.nonzero(report[:, 0] == 0).flatten().tolist():
        a, g, q = (call[name][index].numpy() for name in ("A", "G", "Q"))
        item = index if len(report) > 1 else None
        raise_riccati_failure(a, g, q, float(report[index, 2]), item)


# With A_c = A - G P the differential is A_c' dP + dP A_c + dA' P + P dA - P dG P + dQ = 0, so with
# A_c S + S A_c' + sym(dL/dP) = 0:  dL/dA = 2 P S,  dL/dG = -P S P,  dL/dQ = S.
def _care_gradients(given: Given, grads: Given) -> dict[str, Tensor]:
    P, grad_P = given["P"], grads["P"]
    closed = given["A"] - given["G"] @ P
    S = lyapunov(closed, 0.5 * (grad_P + grad_P.mT), given["num_threads"])
    return {"A": 2.0 * P @ S, "G": -P @ S @ P, "Q": S}


def _care_directions(given: Given, moved: Given) -> dict[str, Tensor]:
    P = given["P"]
    load = moved.get("Q", torch.zeros_like(P))
    if "A" in moved:
        load = load + moved["A"].mT @ P + P @ moved["A"]
    if "G" in moved:
        load = load - P @ moved["G"] @ P
    closed = given["A"] - given["G"] @ P
    return {"P": lyapunov(closed.mT, load, given["num_threads"])}


care = Op(  # the stabilizing P of A'P + P A - P G P + Q = 0
    "care",
    inputs={"A": SQUARE, "G": SQUARE, "Q": SQUARE},
    outputs={"P": SQUARE, "report": array("batch", len(REPORT), smooth=False)},
    options="int num_threads",
    reads=("A", "G", "P"),
    kernel=_care,
    backward=_care_gradients,
    forward=_care_directions,
)
