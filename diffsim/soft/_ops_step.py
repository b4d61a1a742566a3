"""The implicit step of a soft body and its derivatives as an op."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import ConvergenceError, ConvergenceWarning
from diffsim.core.ops import Call, Op, array
from diffsim.core.record import warn
from diffsim.soft._arrays import NODAL, StepArrays, require_array
from diffsim.soft._context import (
    context,
    context_of,
    owner,
    require_upright,
    sizes_of_call,
    soft_addresses,
)
from diffsim.soft._solves import STATS, notify

LINEAR = "linearly_implicit"
METHODS = ("auto", "quasi_newton", "newton_pcg", "newton_jacobi", "newton_cholesky", LINEAR)
TANGENT_HINT = "lower rtol of the steps or raise adjoint_max_iters"
STEP_HINT = "halve dt, raise max_iters, or loosen rtol (or set atol) where rounding forbids less"
LINEAR_HINT = "halve dt, or take method='auto', which follows a body through buckling"
ADJOINT_HINT = "loosen adjoint_rtol or raise max_iters"


def step_options(method: str, *, rtol: float, max_iters: int, atol: float = 0.0) -> Any:
    """Solver and tolerances as kernels take them."""
    options = core.StepOptions()
    options.method = getattr(core.StepMethod, method)
    options.rtol, options.atol, options.max_iters = rtol, atol, max_iters
    return options


def report_failure(stats: Tensor, what: str, hint: str, on_failure: str) -> None:
    # called too often for torch, and for reductions of NumPy
    if 0.0 not in stats.numpy()[:, STATS.index("converged")].tolist():
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


def new_stats(batch: int) -> Tensor:
    """Room for ``STATS`` of each item."""
    return torch.zeros(batch, len(STATS), dtype=torch.float64)


class BoundStep:
    """Implicit steps that share their parameters, checked and handed to the solver once.

    Args:
        arrays: Inputs of one of the steps.
        handle: Of the body's prepared solvers.
        method, preconditioner, rtol, atol, max_iters, num_threads, on_failure, adjoint_rtol,
            adjoint_max_iters: As in ``SolverOptions``; those of the adjoint serve tangents.
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
        self._context = context(handle, arrays.tables)
        self._batch = arrays.y.shape[0]
        shapes = arrays.shapes(self._batch, self._context.sizes)
        self._moving = {n: s for n, s in shapes.items() if StepArrays.is_batched(n)}
        arrays.require_shapes({n: s for n, s in shapes.items() if n not in self._moving})
        self._shared = {n: getattr(arrays, n) for n in shapes if n not in self._moving}
        self._system = self._context.system(arrays, num_threads, method, preconditioner)
        self._options = step_options(method, rtol=rtol, atol=atol, max_iters=max_iters)
        self._max_iters, self._num_threads, self._on_failure = max_iters, num_threads, on_failure
        self._method, self._adjoint_max_iters = method, adjoint_max_iters
        self._adjoint_options = step_options(method, rtol=adjoint_rtol, max_iters=adjoint_max_iters)
        self._is_per_member = arrays.per_member
        self._hint = LINEAR_HINT if method == LINEAR else STEP_HINT

    def shares(self, arrays: StepArrays) -> bool:
        """Whether a step has the very tensors that are shared."""
        same = all(getattr(arrays, name) is tensor for name, tensor in self._shared.items())
        return same and arrays.y.shape[0] == self._batch

    def __call__(self, arrays: StepArrays, *, keep: bool = False) -> tuple[Tensor, Tensor]:
        """x (batch, num_nodes, 3) [m] and stats of a step that :meth:`shares` its parameters.

        Args:
            keep: Whether an adjoint is likely to follow: linearly implicit steps of small bodies
                keep their factors for it.
        """
        arrays.require_shapes(self._moving)
        self._options.keep = keep
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

    def adjoint(self, moving: Mapping[str, Tensor], x: Tensor, grad_x: Tensor) -> dict[str, Tensor]:
        """Gradients of what differs between the items of a batch; none by what they share.

        Args:
            moving: Those arrays of the step, by name.
            x, grad_x: Its answer [m] and the gradient of that, (batch, num_nodes, 3).

        Returns:
            By name; ``guess`` of linearly implicit steps only, the frame's where there is damping.
        """
        require_array("x", x, self._moving["y"])
        require_array("grad_x", grad_x, self._moving["y"])
        wanted = [n for n in moving if n != "guess" or self._method == LINEAR]
        grads = {n: torch.empty_like(moving[n]) for n in wanted if self._moving[n] != (0,)}
        # kernels write these of a damped or linear step, whoever asks
        written = self._shared if self._method == LINEAR else ("damp_mu", "damp_lambda")
        own = {n: self._shared[n] for n in written if n != "tables"}
        spare = {
            n: t.new_empty(t.shape if self._is_per_member else (self._batch, *t.shape))
            for n, t in own.items()
        }
        stats = new_stats(self._batch)
        core.implicit_step_adjoint(
            system=self._system,
            options=self._adjoint_options,
            num_threads=self._num_threads,
            inputs=soft_addresses({**self._shared, **moving}),
            batch=self._batch,
            x=x.data_ptr(),
            grad_x=grad_x.data_ptr(),
            grads=soft_addresses({**spare, **grads}),
            stats=stats.data_ptr(),
        )
        notify("adjoint", stats, self._adjoint_max_iters)
        report_failure(stats, "adjoint solve", ADJOINT_HINT, self._on_failure)
        return grads

    def tangents(self, arrays: StepArrays, x: Tensor, directions: Mapping[str, Tensor]) -> Tensor:
        """Derivatives of a converged step along K directions, with one factor of its tangent.

        Args:
            arrays: Arrays of the step, of batch 1.
            x: Its answer, (1, num_nodes, 3) [m].
            directions: By name of ``StepArrays.specs``, with a leading K instead of the
                batch axis; what does not move may be missing.

        Returns:
            (K, num_nodes, 3).
        """
        shapes = self._moving | {name: tensor.shape for name, tensor in self._shared.items()}
        arrays.require_shapes(self._moving)
        require_array("x", x, shapes["y"])
        count = next(iter(directions.values())).shape[0]
        for name, direction in directions.items():
            one = shapes[name][1:] if StepArrays.is_batched(name) else shapes[name]
            require_array(f"direction of {name}", direction, (count, *one))
        dx = x.new_empty(count, *x.shape[1:])
        stats = new_stats(1)
        core.implicit_step_tangent(
            system=self._system,
            inputs=soft_addresses(arrays.named()),
            options=self._adjoint_options,
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


def _step(call: Call) -> None:
    arrays = StepArrays.of(call)
    call["x"], call["stats"] = BoundStep(arrays, **call.options)(arrays, keep=True)


def system_of(call: Call, **choice: bool) -> dict[str, Any]:
    """What kernels of derivatives take of the body and of its options."""
    options, arrays = call.options, StepArrays.of(call)
    method, num_threads = options["method"], options["num_threads"]
    return {
        "system": context_of(call).system(
            arrays, num_threads, method, options["preconditioner"], **choice
        ),
        "options": step_options(
            method, rtol=options["adjoint_rtol"], max_iters=options["adjoint_max_iters"]
        ),
        "num_threads": num_threads,
    }


def finish(call: Call, what: str, stats: Tensor, where: str = "") -> None:
    """Hand on and judge how the solve of a derivative ended."""
    hint = {"adjoint": ADJOINT_HINT, "tangent": TANGENT_HINT}[what]
    notify(what, stats, call.options["adjoint_max_iters"], contact=bool(where))
    report_failure(stats, f"{what} solve{where}", hint, call.options["on_failure"])


# H z = dL/dx, then dL/dp = -z . d(grad g)/dp (thesis eqs. 4.9, 4.10): one solve for all inputs.
def _adjoint(call: Call) -> None:
    arrays, batch = StepArrays.of(call), call.sizes["batch"]
    stats = new_stats(batch)
    core.implicit_step_adjoint(
        **system_of(call),
        inputs=soft_addresses(arrays.named()),
        batch=batch,
        **call.addresses("x", "grad_x"),
        grads=soft_addresses(arrays.gradients(call)),
        stats=stats.data_ptr(),
    )
    finish(call, "adjoint", stats)
    arrays.add_gradients(call)


def _tangent(call: Call) -> None:
    arrays, batch = StepArrays.of(call), call.sizes["batch"]
    moved, stats = arrays.moved(call), new_stats(batch)
    for k in range(batch):
        core.implicit_step_tangent(
            **system_of(call),
            inputs=soft_addresses(arrays.item(k)),
            count=1,
            x=call["x"][k].data_ptr(),
            directions=soft_addresses(arrays.item_of(moved, k)),
            dx=call["d_x"][k].data_ptr(),
            stats=stats[k].data_ptr(),
        )
    finish(call, "tangent", stats)


OPTIONS = (
    "str method, str preconditioner, float rtol, float atol, int max_iters, "
    "int num_threads, str on_failure, float adjoint_rtol, int adjoint_max_iters"
)
STATS_ARRAY = array("batch", len(STATS), smooth=False, zeroed=True)
soft_step = Op(  # one implicit step of a batch; csrc/kernels/soft/implicit_step.h
    "soft_step",
    inputs=StepArrays.specs,
    outputs={"x": array(*NODAL), "stats": STATS_ARRAY},
    options=f"int handle, {OPTIONS}",
    sizes=sizes_of_call,
    owner=owner,
    reads=("x", *StepArrays.specs),
    kernel=_step,
    adjoint=_adjoint,
    tangent=_tangent,
    skips_still=True,
)
