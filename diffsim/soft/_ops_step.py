"""The implicit step of a soft body and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import ConvergenceError, ConvergenceWarning
from diffsim.soft._context import (
    SHARED_INPUTS,
    STEP_GRADIENTS,
    STEP_INPUTS,
    context,
    gradient_buffers,
    pointers,
    require_sizes,
    require_upright,
    sum_shared,
)

METHODS = ("auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky")
STATS = (
    "residual_norm",
    "tolerance",
    "scale",
    "num_iters",
    "num_solves",
    "num_factorizations",
    "energy",
    "converged",
    "num_contacts",
    "num_slipping",
    "num_set_changes",
    "num_cycles",
)
TANGENT_HINT = "lower rtol of the steps or raise adjoint_max_iters"
STEP_HINT = "halve dt, raise max_iters, or loosen rtol (or set atol) where rounding forbids less"
ADJOINT_HINT = "loosen adjoint_rtol or raise max_iters"


def step_options(method: str, rtol: float, atol: float, max_iters: int) -> object:
    options = core.StepOptions()
    options.method = getattr(core.StepMethod, method)
    options.rtol, options.atol, options.max_iters = rtol, atol, max_iters
    return options


listeners: list[Callable[[str, Tensor], None]] = []
"""Called with ("step" or "adjoint", stats) after every solve; see diffsim.soft.record_stats."""


def notify(kind: str, stats: Tensor) -> None:
    for listen in listeners:
        listen(kind, stats)


def report_failure(stats: Tensor, what: str, hint: str, on_failure: str) -> None:
    failed = stats[:, 7] == 0
    if not bool(failed.any()):
        return
    row = stats[failed][0]
    residual, tolerance, iters = float(row[0]), float(row[1]), int(row[3])
    message = (
        f"{what} stopped after {iters} iterations at residual {residual:.3e}, needed "
        f"{tolerance:.3e}; {hint}"
    )
    if on_failure == "warn" and math.isfinite(residual):
        warnings.warn(message, ConvergenceWarning, stacklevel=2)
        return
    raise ConvergenceError(message, residual_norm=residual, tolerance=tolerance, num_iters=iters)


@torch.library.custom_op("diffsim::soft_step", mutates_args=())
def soft_step(
    inputs: list[Tensor],
    handle: int,
    method: str,
    rtol: float,
    atol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
    adjoint_rtol: float,
    adjoint_max_iters: int,
) -> tuple[Tensor, Tensor]:
    """One implicit step of a batch; see csrc/kernels/soft/implicit_step.h. Returns x and stats.

    ``inputs`` are those of ``STEP_INPUTS``, in that order.
    """
    ctx = context(handle)
    named = dict(zip(STEP_INPUTS, inputs, strict=True))
    y = named["y"]
    require_sizes(ctx, y.shape[0], named)
    system = ctx.system(named, num_threads)
    x = torch.empty_like(y)
    stats = torch.zeros(y.shape[0], len(STATS), dtype=torch.float64)
    core.implicit_step(
        system,
        pointers(**named),
        step_options(method, rtol, atol, max_iters),
        y.shape[0],
        x.data_ptr(),
        stats.data_ptr(),
        num_threads,
    )
    notify("step", stats)
    require_upright(ctx, stats[:, STATS.index("energy")], x)  # x is the start where that failed
    report_failure(stats, "implicit step", STEP_HINT, on_failure)
    return x, stats


@soft_step.register_fake
def _(inputs, *args):
    return torch.empty_like(inputs[0]), inputs[0].new_empty(inputs[0].shape[0], len(STATS))


@torch.library.custom_op("diffsim::soft_step_vjp", mutates_args=())
def soft_step_vjp(
    grad_x: Tensor,
    x: Tensor,
    inputs: list[Tensor],
    handle: int,
    method: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> list[Tensor]:
    """Adjoint of :func:`soft_step`; gradients of ``STEP_GRADIENTS`` in order, then stats."""
    ctx = context(handle)
    named = dict(zip(STEP_INPUTS, inputs, strict=True))
    batch = x.shape[0]
    grad_x = grad_x.contiguous()
    require_sizes(ctx, batch, {**named, "x": x, "grad_x": grad_x})
    system = ctx.system(named, num_threads)
    grads = gradient_buffers(named, STEP_GRADIENTS, batch)
    stats = torch.zeros(batch, len(STATS), dtype=torch.float64)
    core.implicit_step_adjoint(
        system,
        pointers(**named),
        step_options(method, rtol, 0.0, max_iters),
        batch,
        x.data_ptr(),
        grad_x.data_ptr(),
        pointers(**grads),
        stats.data_ptr(),
        num_threads,
    )
    notify("adjoint", stats)
    report_failure(stats, "adjoint solve", ADJOINT_HINT, on_failure)
    return [*sum_shared(grads), stats]


@soft_step_vjp.register_fake
def _(grad_x, x, inputs, *args):
    like = [t for name, t in zip(STEP_INPUTS, inputs, strict=True) if name in STEP_GRADIENTS]
    return [*(torch.empty_like(t) for t in like), x.new_empty(x.shape[0], len(STATS))]


def _step_setup(ctx, inputs, output):
    tensors, ctx.handle, ctx.method, *_, ctx.num_threads, ctx.on_failure, ctx.rtol, ctx.iters = (
        inputs
    )
    ctx.save_for_backward(output[0], *tensors)
    ctx.owner = context(ctx.handle)  # the graph keeps the prepared solver, if its body is deleted
    ctx.mark_non_differentiable(output[1])


def _step_backward(ctx, grad_x, _grad_stats):
    # H z = dL/dx, then dL/dp = -z . d(grad g)/dp (thesis eqs. 4.9, 4.10): one solve for all inputs.
    x, *tensors = ctx.saved_tensors
    *grads, _stats = soft_step_vjp(
        grad_x, x, tensors, ctx.handle, ctx.method, ctx.rtol, ctx.iters, ctx.num_threads,
        ctx.on_failure,
    )  # fmt: skip
    named = dict(zip(STEP_GRADIENTS, grads, strict=True))
    return [named.get(name) for name in STEP_INPUTS], *([None] * 9)


soft_step.register_autograd(_step_backward, setup_context=_step_setup)


def step_tangents(
    x: Tensor,
    inputs: list[Tensor],
    directions: dict[str, Tensor],
    handle: int,
    method: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> Tensor:
    """Derivatives of one converged step along K directions, all with one factor of its tangent.

    Args:
        x: Answer of the step, (1, V, 3) [m].
        inputs: Of the step, those of ``STEP_INPUTS`` in that order, of batch 1.
        directions: By name of ``STEP_GRADIENTS``, with a leading K instead of the batch axis;
            what does not move may be missing.
        handle, method, rtol, max_iters, num_threads, on_failure: As for :func:`soft_step_vjp`.

    Returns:
        (K, V, 3).
    """
    ctx = context(handle)
    named = dict(zip(STEP_INPUTS, inputs, strict=True))
    require_sizes(ctx, 1, {**named, "x": x})
    count = next(iter(directions.values())).shape[0]
    shaped = {name: named[name] for name in directions}
    for name, direction in directions.items():
        one = shaped[name].shape if name in SHARED_INPUTS else shaped[name].shape[1:]
        if direction.shape != (count, *one) or not direction.is_contiguous():
            raise ValueError(
                f"direction of {name} must be contiguous {(count, *one)}, got "
                f"{tuple(direction.shape)}"
            )
    system = ctx.system(named, num_threads)
    dx = x.new_empty(count, *x.shape[1:])
    stats = torch.zeros(1, len(STATS), dtype=torch.float64)
    core.implicit_step_tangent(
        system,
        pointers(**named),
        step_options(method, rtol, 0.0, max_iters),
        count,
        x.data_ptr(),
        pointers(**directions),
        dx.data_ptr(),
        stats.data_ptr(),
        num_threads,
    )
    notify("tangent", stats)
    report_failure(stats, "tangent solve", TANGENT_HINT, on_failure)
    return dx
