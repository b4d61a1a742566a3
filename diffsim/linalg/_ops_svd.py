"""3x3 singular value and polar decompositions as ops."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Given, Op, array

GAP_TOLERANCE = 1e-15
"""Gaps of singular values below this, relative to s0, are rounding; kGapTolerance of svd3_vjp.h."""
MATRIX = array("...", 3, 3)


# With M = U^T dF V, dU = U X, dV = V Y and X, Y antisymmetric: M = X S + dS - S Y, so
#   ds_i = M_ii,  (s_j^2 - s_i^2) X_ij = s_j M_ij + s_i M_ji,
#                 (s_j^2 - s_i^2) Y_ij = s_i M_ij + s_j M_ji.
def _along_svd(given: Given, moved: Given) -> dict[str, Tensor]:
    U, s, V = given["U"], given["s"], given["V"]
    M = U.mT @ moved["F"] @ V
    row, column = s[..., :, None], s[..., None, :]
    # as in svd3_vjp.h: equal values have no X and Y; not felt where nothing would turn them
    distinct = (row.abs() - column.abs()).abs() > GAP_TOLERANCE * s[..., :1, None]
    over = (column - row) * (column + row)
    blank = torch.full_like(M, torch.nan)
    on_diagonal = torch.eye(3, dtype=torch.bool)

    def turn(first: Tensor, second: Tensor) -> Tensor:
        load = first * M + second * M.mT
        skew = torch.where(distinct, load / over, torch.where(load == 0.0, load, blank))
        return torch.where(on_diagonal, torch.zeros_like(skew), skew)

    X, Y = turn(column, row), turn(row, column)
    return {"U": U @ X, "s": M.diagonal(dim1=-2, dim2=-1), "V": V @ Y}


def _svd3(call: Call) -> None:
    places = call.addresses("F", "U", "s", "V")
    core.svd3(places.pop("F"), call["F"].numel() // 9, *places.values(), call.sizes["num_threads"])


def _svd3_vjp(call: Call) -> None:
    *places, grad_F = call.addresses().values()
    core.svd3_vjp(*places, call["U"].numel() // 9, grad_F, call.sizes["num_threads"])


svd3 = Op(
    "svd3",
    inputs={"F": MATRIX},
    outputs={"U": MATRIX, "s": array("...", 3), "V": MATRIX},
    options="int num_threads",
    reads=("U", "s", "V"),
    kernel=_svd3,
    adjoint=_svd3_vjp,
    forward=_along_svd,
)


def _polar3(call: Call) -> None:
    F, R = call.addresses().values()
    core.polar3(F, call["F"].numel() // 9, R, call.sizes["num_threads"])


def _polar3_vjp(call: Call) -> None:
    *places, grad_F = call.addresses().values()
    core.polar3_vjp(*places, call["F"].numel() // 9, grad_F, call.sizes["num_threads"])


# dR = R [w], (tr(H) 1 - H) w = axial(R^T dF - dF^T R): eigenvalues s_i + s_j, no differences. The
# map from dF to dR is symmetric, so it is its own adjoint.
polar3 = Op(
    "polar3",
    inputs={"F": MATRIX},
    outputs={"R": MATRIX},
    options="int num_threads",
    reads=("F", "R"),
    kernel=_polar3,
    adjoint=_polar3_vjp,
    tangent=_polar3_vjp,
)
