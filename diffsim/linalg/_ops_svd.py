"""3x3 singular value and polar decompositions: allocate outputs, pass addresses, register ops."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.custom_op import custom_op


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
