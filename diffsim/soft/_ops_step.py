"""The implicit step of a soft body and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import ConvergenceError, ConvergenceWarning
from diffsim.core.layer import custom_op, make_first_order, make_layer
from diffsim.core.record import warn
from diffsim.soft._arrays import StepArrays, require_array
from diffsim.soft._context import SoftContext, context, require_upright, soft_addresses
from diffsim.soft._solves import STATS, notify

LINEAR = "linearly_implicit"
METHODS = ("auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky", LINEAR)
TANGENT_HINT = "lower rtol of the steps or raise adjoint_max_iters"
STEP_HINT = "halve dt, raise max_iters, or loosen rtol (or set atol) where rounding forbids less"
LINEAR_HINT = "halve dt, or take method='auto', which follows a body through buckling"
ADJOINT_HINT = "loosen adjoint_rtol or raise max_iters"


def step_options(method: str, *, rtol: float, max_iters: int, atol: float = 0.0) -> object:
    """Solver and tolerances as kernels take them."""
    options = core.StepOptions()
    options.method = getattr(core.StepMethod, method)
    options.rtol, options.atol, options.max_iters = rtol, atol, max_iters
    return options


def report_failure(stats: Tensor, what: str, hint: str, on_failure: str) -> None:
    converged = stats.numpy()[:, STATS.index("converged")]  # called too often for torch
    if converged.all():
        return
    failed = stats[:, STATS.index("converged")] == 0
    row = dict(zip(STATS, stats[failed][0].tolist(), strict=True))
    residual, tolerance, iters = row["residual_norm"], row["tolerance"], int(row["num_iters"])
    message = (
        f"{what} stopped after {iters} iterations at residual {residual:.3e}, needed "
        f"{tolerance:.3e}; {hint}"
    )
    if on_failure == "warn" and math.isfinite(residual):
        warn(message, ConvergenceWarning, stacklevel=2)
        return
    raise ConvergenceError(message, residual_norm=residual, tolerance=tolerance, num_iters=iters)


def require_step(ctx: SoftContext, inputs: list[Tensor], batch: int, **nodal: Tensor) -> StepArrays:
    """The arrays of a step, and further (batch, num_nodes, 3) ones, of the body's sizes."""
    arrays = StepArrays.of(inputs)
    arrays.require_sizes(batch, ctx.sizes, damped=arrays.damped)
    for name, tensor in nodal.items():
        require_array(name, tensor, (batch, ctx.num_nodes, 3))
    return arrays


def new_stats(batch: int) -> Tensor:
    """Room for ``STATS`` of each item."""
    return torch.zeros(batch, len(STATS), dtype=torch.float64)


class BoundStep:
    """Implicit steps that share their parameters, checked and handed to the solver once.

    Args:
        arrays: Inputs of one of the steps.
        handle, method, preconditioner, rtol, atol, max_iters, num_threads, on_failure,
            adjoint_rtol, adjoint_max_iters: As for :func:`soft_step`; those of the adjoint serve
            tangents.
    """

    def __init__(
        self,
        arrays: StepArrays,
        *,
        handle: int,
        method: str,
        preconditioner: str,
        rtol: float,
        atol: float,
        max_iters: int,
        num_threads: int,
        on_failure: str,
        adjoint_rtol: float,
        adjoint_max_iters: int,
    ):
        self._context = context(handle)
        self._batch = arrays.y.shape[0]
        shapes = arrays.shapes(self._batch, self._context.sizes, damped=arrays.damped)
        self._moving = {n: s for n, s in shapes.items() if StepArrays.specs[n].batched}
        arrays.require_shapes({n: s for n, s in shapes.items() if n not in self._moving})
        self._shared = {n: getattr(arrays, n) for n in shapes if n not in self._moving}
        self._system = self._context.system(arrays, num_threads, method, preconditioner)
        self._options = step_options(method, rtol=rtol, atol=atol, max_iters=max_iters)
        self._max_iters, self._num_threads, self._on_failure = max_iters, num_threads, on_failure
        self._method, self._adjoint_rtol = method, adjoint_rtol
        self._adjoint_max_iters = adjoint_max_iters
        self._hint = LINEAR_HINT if method == LINEAR else STEP_HINT

    def shares(self, arrays: StepArrays) -> bool:
        """Whether a step has the very tensors that are shared."""
        same = all(getattr(arrays, name) is tensor for name, tensor in self._shared.items())
        return same and arrays.y.shape[0] == self._batch

    def __call__(self, arrays: StepArrays) -> tuple[Tensor, Tensor]:
        """x (batch, num_nodes, 3) [m] and stats of a step that :meth:`shares` its parameters."""
        arrays.require_shapes(self._moving)
        x = torch.empty_like(arrays.y)
        stats = new_stats(self._batch)
        core.implicit_step(
            system=self._system,
            inputs=soft_addresses(arrays.named()),
            options=self._options,
            batch=self._batch,
            x=x.data_ptr(),
            stats=stats.data_ptr(),
            num_threads=self._num_threads,
        )
        notify("step", stats, self._max_iters)
        # x is the start where that failed
        require_upright(self._context, stats[:, STATS.index("energy")], x)
        report_failure(stats, "implicit step", self._hint, self._on_failure)
        return x, stats

    def tangents(self, arrays: StepArrays, x: Tensor, directions: Mapping[str, Tensor]) -> Tensor:
        """Derivatives of a converged step along K directions, with one factor of its tangent.

        Args:
            arrays: Arrays of the step, of batch 1.
            x: Its answer, (1, num_nodes, 3) [m].
            directions: By name of ``StepArrays.differentiable()``, with a leading K instead of the
                batch axis; what does not move may be missing.

        Returns:
            (K, num_nodes, 3).
        """
        shapes = self._moving | {name: tensor.shape for name, tensor in self._shared.items()}
        arrays.require_shapes(self._moving)
        require_array("x", x, shapes["y"])
        count = next(iter(directions.values())).shape[0]
        for name, direction in directions.items():
            one = shapes[name][1:] if StepArrays.specs[name].batched else shapes[name]
            require_array(f"direction of {name}", direction, (count, *one))
        options = step_options(
            self._method, rtol=self._adjoint_rtol, max_iters=self._adjoint_max_iters
        )
        dx = x.new_empty(count, *x.shape[1:])
        stats = new_stats(1)
        core.implicit_step_tangent(
            system=self._system,
            inputs=soft_addresses(arrays.named()),
            options=options,
            count=count,
            x=x.data_ptr(),
            directions=soft_addresses(directions),
            dx=dx.data_ptr(),
            stats=stats.data_ptr(),
            num_threads=self._num_threads,
        )
        notify("tangent", stats, self._adjoint_max_iters)
        report_failure(stats, "tangent solve", TANGENT_HINT, self._on_failure)
        return dx


@custom_op("diffsim::soft_step")
def soft_step(
    inputs: list[Tensor],
    *,
    handle: int,
    method: str,
    preconditioner: str,
    rtol: float,
    atol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
    adjoint_rtol: float,
    adjoint_max_iters: int,
) -> tuple[Tensor, Tensor]:
    """One implicit step of a batch; see csrc/kernels/soft/implicit_step.h.

    Args:
        inputs: Tensors of a :class:`StepArrays`.

    Returns:
        x (batch, num_nodes, 3) [m], stats.
    """
    arrays = StepArrays.of(inputs)
    bound = BoundStep(
        arrays,
        handle=handle,
        method=method,
        preconditioner=preconditioner,
        rtol=rtol,
        atol=atol,
        max_iters=max_iters,
        num_threads=num_threads,
        on_failure=on_failure,
        adjoint_rtol=adjoint_rtol,
        adjoint_max_iters=adjoint_max_iters,
    )
    return bound(arrays)


@soft_step.register_fake
def _(inputs, **_options):
    y = StepArrays.of(inputs).y
    return torch.empty_like(y), y.new_empty(y.shape[0], len(STATS))


@custom_op("diffsim::soft_step_vjp")
def soft_step_vjp(
    grad_x: Tensor,
    x: Tensor,
    inputs: list[Tensor],
    *,
    handle: int,
    method: str,
    preconditioner: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> list[Tensor]:
    """Adjoint of :func:`soft_step`: gradients of ``StepArrays.differentiable()``, then stats."""
    ctx = context(handle)
    batch = x.shape[0]
    grad_x = grad_x.contiguous()
    arrays = require_step(ctx, inputs, batch, x=x, grad_x=grad_x)
    grads = arrays.gradient_buffers(batch)
    stats = new_stats(batch)
    core.implicit_step_adjoint(
        system=ctx.system(arrays, num_threads, method, preconditioner),
        inputs=soft_addresses(arrays.named()),
        options=step_options(method, rtol=rtol, max_iters=max_iters),
        batch=batch,
        x=x.data_ptr(),
        grad_x=grad_x.data_ptr(),
        grads=soft_addresses(grads),
        stats=stats.data_ptr(),
        num_threads=num_threads,
    )
    notify("adjoint", stats, max_iters)
    report_failure(stats, "adjoint solve", ADJOINT_HINT, on_failure)
    return [*arrays.summed(grads), stats]


@soft_step_vjp.register_fake
def _(grad_x, x, inputs, **_options):
    return [*StepArrays.of(inputs).empty_gradients(), x.new_empty(x.shape[0], len(STATS))]


def adjoint_arguments(step: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of a step's adjoint from those of the step."""
    same = ("handle", "method", "preconditioner", "num_threads", "on_failure")
    own = {"rtol": step["adjoint_rtol"], "max_iters": step["adjoint_max_iters"]}
    return {name: step[name] for name in same} | own


def _step_setup(ctx, inputs, keyword_only_inputs, output):
    (tensors,) = inputs
    ctx.arguments = adjoint_arguments(keyword_only_inputs)
    ctx.save_for_backward(output[0], *tensors)
    ctx.owner = context(ctx.arguments["handle"])  # keeps the prepared solver of a deleted body
    ctx.mark_non_differentiable(output[1])


def _step_backward(ctx, grad_x, _grad_stats):
    # H z = dL/dx, then dL/dp = -z . d(grad g)/dp (thesis eqs. 4.9, 4.10): one solve for all inputs.
    x, *tensors = ctx.saved_tensors
    *grads, _stats = soft_step_vjp_layer(grad_x, x, tensors, **ctx.arguments)
    return StepArrays.all_gradients(grads)


@custom_op("diffsim::soft_step_jvp")
def soft_step_jvp(
    x: Tensor,
    inputs: list[Tensor],
    directions: list[Tensor],
    *,
    handle: int,
    method: str,
    preconditioner: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> Tensor:
    """Derivative of :func:`soft_step` along one direction of its inputs, for every batch item.

    Args:
        x: Answer of the step, (batch, num_nodes, 3) [m].
        inputs: Tensors of a :class:`StepArrays`.
        directions: Tangents in the same order; an empty tensor where an input does not move.

    Returns:
        (batch, num_nodes, 3).
    """
    ctx = context(handle)
    x = x.contiguous()
    arrays = require_step(ctx, inputs, x.shape[0], x=x)
    moved = arrays.moving(directions)
    dx, stats = torch.empty_like(x), new_stats(x.shape[0])
    for k in range(x.shape[0]):
        core.implicit_step_tangent(
            system=ctx.system(arrays, num_threads, method, preconditioner),
            inputs=soft_addresses(arrays.item(k)),
            options=step_options(method, rtol=rtol, max_iters=max_iters),
            count=1,
            x=x[k].data_ptr(),
            directions=soft_addresses(arrays.item_of(moved, k)),
            dx=dx[k].data_ptr(),
            stats=stats[k].data_ptr(),
            num_threads=num_threads,
        )
    notify("tangent", stats, max_iters)
    report_failure(stats, "tangent solve", TANGENT_HINT, on_failure)
    return dx


@soft_step_jvp.register_fake
def _(x, inputs, directions, **_options):
    return torch.empty_like(x)


def _step_tangent(ctx, moved):
    x, *tensors = ctx.saved_tensors
    return soft_step_jvp_layer(x, tensors, StepArrays.directions(moved, x), **ctx.arguments), None


soft_step_vjp_layer = make_first_order(soft_step_vjp)
soft_step_jvp_layer = make_first_order(soft_step_jvp)
soft_step_layer = make_layer(
    soft_step, setup=_step_setup, backward=_step_backward, tangent=_step_tangent
)
