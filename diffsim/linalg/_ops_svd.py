"""3x3 singular value and polar decompositions: allocate outputs, pass addresses, register ops."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, make_first_order, make_layer

GAP_TOLERANCE = 1e-15
"""Gaps of singular values below this, relative to s0, are rounding; kGapTolerance of svd3_vjp.h."""


def _check(name: str, value: Tensor, like: tuple[int, ...]) -> Tensor:
    """What the kernels rely on; diffsim/linalg/svd.py has said it to the user in full already."""
    if value.dtype != torch.float64 or value.device.type != "cpu" or value.shape != like:
        raise ValueError(
            f"{name} must be a float64 CPU tensor of shape {tuple(like)}, got {value.dtype} on "
            f"{value.device} of shape {tuple(value.shape)}"
        )
    return value.contiguous()


def _matrices(name: str, value: Tensor) -> tuple[Tensor, int]:
    if value.shape[-2:] != (3, 3):
        raise ValueError(f"{name} must have shape (..., 3, 3), got {tuple(value.shape)}")
    return _check(name, value, value.shape), value.numel() // 9


@custom_op("diffsim::svd3")
def svd3(F: Tensor, num_threads: int) -> tuple[Tensor, Tensor, Tensor]:
    """U (..., 3, 3), s (..., 3), V (..., 3, 3) of F (..., 3, 3)."""
    F, n = _matrices("F", F)
    U, V = torch.empty_like(F), torch.empty_like(F)
    s = F.new_empty(F.shape[:-1])
    core.svd3(F.data_ptr(), n, U.data_ptr(), s.data_ptr(), V.data_ptr(), num_threads)
    return U, s, V


@svd3.register_fake
def _(F: Tensor, num_threads: int) -> tuple[Tensor, Tensor, Tensor]:
    return F.new_empty(F.shape), F.new_empty(F.shape[:-1]), F.new_empty(F.shape)


@custom_op("diffsim::svd3_vjp")
def svd3_vjp(
    U: Tensor,
    s: Tensor,
    V: Tensor,
    grad_U: Tensor,
    grad_s: Tensor,
    grad_V: Tensor,
    num_threads: int,
) -> Tensor:
    """dL/dF (..., 3, 3) from the outputs of ``svd3`` and dL/d of each."""
    U, n = _matrices("U", U)
    s = _check("s", s, U.shape[:-1])
    V = _check("V", V, U.shape)
    grad_U = _check("grad_U", grad_U, U.shape)
    grad_s = _check("grad_s", grad_s, U.shape[:-1])
    grad_V = _check("grad_V", grad_V, U.shape)
    grad_F = torch.empty_like(U)
    core.svd3_vjp(
        *(t.data_ptr() for t in (U, s, V, grad_U, grad_s, grad_V)),
        n,
        grad_F.data_ptr(),
        num_threads,
    )
    return grad_F


@svd3_vjp.register_fake
def _(
    U: Tensor,
    s: Tensor,
    V: Tensor,
    grad_U: Tensor,
    grad_s: Tensor,
    grad_V: Tensor,
    num_threads: int,
) -> Tensor:
    return U.new_empty(U.shape)


@custom_op("diffsim::polar3")
def polar3(F: Tensor, num_threads: int) -> Tensor:
    """The rotations (..., 3, 3) nearest to F (..., 3, 3)."""
    F, n = _matrices("F", F)
    R = torch.empty_like(F)
    core.polar3(F.data_ptr(), n, R.data_ptr(), num_threads)
    return R


@polar3.register_fake
def _(F: Tensor, num_threads: int) -> Tensor:
    return F.new_empty(F.shape)


@custom_op("diffsim::polar3_vjp")
def polar3_vjp(F: Tensor, R: Tensor, grad_R: Tensor, num_threads: int) -> Tensor:
    """dL/dF (..., 3, 3) from F, R = polar3(F) and dL/dR."""
    F, n = _matrices("F", F)
    R = _check("R", R, F.shape)
    grad_R = _check("grad_R", grad_R, F.shape)
    grad_F = torch.empty_like(F)
    core.polar3_vjp(
        F.data_ptr(), R.data_ptr(), grad_R.data_ptr(), n, grad_F.data_ptr(), num_threads
    )
    return grad_F


@polar3_vjp.register_fake
def _(F: Tensor, R: Tensor, grad_R: Tensor, num_threads: int) -> Tensor:
    return F.new_empty(F.shape)


def _setup_svd(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    ctx.save_for_backward(*output)
    ctx.num_threads = inputs[1]


# With M = U^T dF V, dU = U X, dV = V Y and X, Y antisymmetric: M = X S + dS - S Y, so
#   ds_i = M_ii,  (s_j^2 - s_i^2) X_ij = s_j M_ij + s_i M_ji,
#                 (s_j^2 - s_i^2) Y_ij = s_i M_ij + s_j M_ji.
def _backward_svd(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
    contiguous = (grad.contiguous() for grad in grads)
    return svd3_vjp_layer(*ctx.saved_tensors, *contiguous, ctx.num_threads), None


def _tangent_svd(ctx: Any, dF: Tensor, _: None) -> tuple[Tensor, Tensor, Tensor]:
    U, s, V = ctx.saved_tensors
    M = U.mT @ dF @ V
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
    return U @ X, M.diagonal(dim1=-2, dim2=-1), V @ Y


def _setup_polar(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(inputs[0], output)
    ctx.num_threads = inputs[1]


# dR = R [w], (tr(H) 1 - H) w = axial(R^T dF - dF^T R): eigenvalues s_i + s_j, no differences. The
# map from dF to dR is symmetric, so it is its own adjoint.
def _backward_polar(ctx: Any, grad_R: Tensor) -> tuple[Tensor, None]:
    F, R = ctx.saved_tensors
    return polar3_vjp_layer(F, R, grad_R.contiguous(), ctx.num_threads), None


def _tangent_polar(ctx: Any, dF: Tensor, _: None) -> Tensor:
    F, R = ctx.saved_tensors
    return polar3_vjp_layer(F, R, dF.contiguous(), ctx.num_threads)


svd3_vjp_layer = make_first_order(svd3_vjp)
polar3_vjp_layer = make_first_order(polar3_vjp)
svd3_layer = make_layer(svd3, setup=_setup_svd, backward=_backward_svd, tangent=_tangent_svd)
polar3_layer = make_layer(
    polar3, setup=_setup_polar, backward=_backward_polar, tangent=_tangent_polar
)
