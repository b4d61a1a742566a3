"""Dimensionless hover thrusts as torch custom ops; see ``csrc/kernels/copter/hover.h``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core

INFO = ("status", "rank", "free_rank", "num_iters")
STATUSES = ("optimal", "infeasible", "rank_deficient", "not_converged")


def _addresses(*tensors: Tensor) -> list[int]:
    return [t.data_ptr() for t in tensors]


def _check(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """What the kernels rely on; diffsim/copter/hover.py has said it to the user already."""
    if value.dtype != dtype or value.device.type != "cpu" or value.shape != shape:
        raise ValueError(
            f"{name} must be a {dtype} CPU tensor of shape {shape}, got {value.dtype} on "
            f"{value.device} of shape {tuple(value.shape)}"
        )
    return value.contiguous()


def _problem(force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor) -> list[Tensor]:
    batch, _, n = force.shape
    return [
        _check("force", force, (batch, 3, n), torch.float64),
        _check("torque", torque, (batch, 3, n), torch.float64),
        _check("weights", weights, (batch, n), torch.float64),
        _check("upper", upper, (batch, n), torch.float64),
    ]


@torch.library.custom_op("diffsim::hover", mutates_args=())
def hover(
    force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor, barrier: float, num_threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Thrusts (B, n), multipliers (B, 4), bound states (B, n) int64, info (B, 4) int64.

    force and torque (B, 3, n), weights and upper (B, n).
    """
    problem = _problem(force, torque, weights, upper)
    batch, _, n = force.shape
    thrusts, multipliers = force.new_empty(batch, n), force.new_empty(batch, 4)
    state = torch.empty(batch, n, dtype=torch.int64)
    info = torch.empty(batch, len(INFO), dtype=torch.int64)
    results = _addresses(thrusts, multipliers, state, info)
    core.hover(*_addresses(*problem), barrier, batch, n, *results, num_threads)
    return thrusts, multipliers, state, info


@hover.register_fake
def _(
    force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor, barrier: float, num_threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    batch, _, n = force.shape
    state = force.new_empty(batch, n, dtype=torch.int64)
    info = force.new_empty(batch, len(INFO), dtype=torch.int64)
    return force.new_empty(batch, n), force.new_empty(batch, 4), state, info


@torch.library.custom_op("diffsim::hover_vjp", mutates_args=())
def hover_vjp(
    force: Tensor,
    torque: Tensor,
    weights: Tensor,
    upper: Tensor,
    thrusts: Tensor,
    multipliers: Tensor,
    state: Tensor,
    info: Tensor,
    grad_thrusts: Tensor,
    barrier: float,
    num_threads: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """dL/d(force, torque, weights, upper) from the outputs of ``hover`` and dL/dthrusts."""
    problem = _problem(force, torque, weights, upper)
    batch, _, n = force.shape
    found = [
        _check("thrusts", thrusts, (batch, n), torch.float64),
        _check("multipliers", multipliers, (batch, 4), torch.float64),
        _check("state", state, (batch, n), torch.int64),
        _check("info", info, (batch, len(INFO)), torch.int64),
        _check("grad_thrusts", grad_thrusts, (batch, n), torch.float64),
    ]
    # not empty_like: the problem may be an expanded view, the kernel writes densely
    grads = [torch.empty(t.shape, dtype=torch.float64) for t in problem]
    addresses = _addresses(*problem), _addresses(*found), _addresses(*grads)
    core.hover_vjp(*addresses[0], barrier, batch, n, *addresses[1], *addresses[2], num_threads)
    return grads[0], grads[1], grads[2], grads[3]


@hover_vjp.register_fake
def _(
    force: Tensor, torque: Tensor, weights: Tensor, upper: Tensor, *_rest: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return (
        force.new_empty(force.shape),
        force.new_empty(torque.shape),
        force.new_empty(weights.shape),
        force.new_empty(upper.shape),
    )


def _setup(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
    *problem, barrier, num_threads = inputs
    ctx.save_for_backward(*problem, *output)
    ctx.mark_non_differentiable(*output[1:])
    ctx.options = barrier, num_threads


# The KKT system of the free rotors, derived in csrc/kernels/copter/hover_adjoint.cpp.
def _backward(ctx: Any, grad_thrusts: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
    grads = hover_vjp(*ctx.saved_tensors, grad_thrusts.contiguous(), *ctx.options)
    return (*grads, None, None)


hover.register_autograd(_backward, setup_context=_setup)
