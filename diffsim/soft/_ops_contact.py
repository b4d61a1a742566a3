"""The implicit step in contact and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64; the nodes in contact are shared by the batch.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.soft._context import (
    STEP_GRADIENTS,
    STEP_INPUTS,
    context,
    gradient_buffers,
    pointers,
    require_sizes,
    require_upright,
    sum_shared,
)
from diffsim.soft._ops_step import (
    ADJOINT_HINT,
    STATS,
    STEP_HINT,
    notify,
    report_failure,
    step_options,
)

CONTACT_INPUTS = ("normal", "reference", "offset", "friction", "force_guess")
CONTACT_GRADIENTS = CONTACT_INPUTS[:-1]


def _contact_pointers(num_contacts: int, **tensors: Tensor) -> object:
    arrays = core.ContactArrays()
    arrays.num_contacts = num_contacts
    for name, tensor in tensors.items():
        if tensor.numel():
            setattr(arrays, name, tensor.data_ptr())
    return arrays


def _require_contacts(
    num_vertices: int, batch: int, nodes: Tensor, tensors: dict[str, Tensor]
) -> None:
    """Kernels read whole arrays: refuse any other size before they do."""
    if nodes.dtype != torch.int64 or nodes.ndim != 1 or not nodes.is_contiguous():
        raise TypeError("contact nodes must be a contiguous int64 vector")
    count = nodes.shape[0]
    if count and (int(nodes.min()) < 0 or int(nodes.max()) >= num_vertices):
        raise ValueError(f"contact nodes must lie in [0, {num_vertices})")
    for name, tensor in tensors.items():
        vector = name not in ("offset", "friction")
        shape = (batch, count, 3) if vector else (batch, count)
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
        if tensor.dtype != torch.float64 or not tensor.is_contiguous():
            raise TypeError(f"{name} must be contiguous float64")


@torch.library.custom_op("diffsim::contact_step", mutates_args=())
def contact_step(
    inputs: list[Tensor],
    contacts: list[Tensor],
    nodes: Tensor,
    handle: int,
    cache_columns: bool,
    method: str,
    rtol: float,
    atol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
    adjoint_rtol: float,
    adjoint_max_iters: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One implicit step of a batch in contact; see csrc/kernels/soft/contact/contact_step.h.

    Args:
        inputs: Those of ``STEP_INPUTS``, in that order.
        contacts: Those of ``CONTACT_INPUTS``, in that order.
        nodes: (num_contacts,) int64, no node twice.

    Returns:
        x, contact force (batch, num_contacts, 3), status (batch, num_contacts) int64, stats.
    """
    ctx = context(handle)
    named = dict(zip(STEP_INPUTS, inputs, strict=True))
    planes = dict(zip(CONTACT_INPUTS, contacts, strict=True))
    y = named["y"]
    batch, count = y.shape[0], nodes.shape[0]
    require_sizes(ctx, batch, named)
    _require_contacts(ctx.num_vertices, batch, nodes, planes)
    x = torch.empty_like(y)
    force = y.new_zeros(batch, count, 3)
    status = torch.zeros(batch, count, dtype=torch.int64)
    stats = torch.zeros(batch, len(STATS), dtype=torch.float64)
    core.contact_step(
        ctx.system(named, num_threads),
        pointers(**named),
        _contact_pointers(count, node=nodes, **planes),
        step_options(method, rtol, atol, max_iters),
        cache_columns,
        batch,
        x.data_ptr(),
        force.data_ptr(),
        status.data_ptr(),
        stats.data_ptr(),
        num_threads,
    )
    notify("step", stats)
    require_upright(ctx, stats[:, STATS.index("energy")], x)  # x is the start where that failed
    report_failure(stats, "implicit step in contact", STEP_HINT, on_failure)
    return x, force, status, stats


@contact_step.register_fake
def _(inputs, contacts, nodes, *args):
    y = inputs[0]
    batch, count = y.shape[0], nodes.shape[0]
    return (
        torch.empty_like(y),
        y.new_empty(batch, count, 3),
        y.new_empty(batch, count, dtype=torch.int64),
        y.new_empty(batch, len(STATS)),
    )


@torch.library.custom_op("diffsim::contact_step_vjp", mutates_args=())
def contact_step_vjp(
    grad_x: Tensor,
    grad_force: Tensor,
    x: Tensor,
    status: Tensor,
    inputs: list[Tensor],
    contacts: list[Tensor],
    nodes: Tensor,
    handle: int,
    cache_columns: bool,
    method: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> list[Tensor]:
    """Adjoint of :func:`contact_step`: ``STEP_GRADIENTS``, ``CONTACT_GRADIENTS``, stats."""
    ctx = context(handle)
    named = dict(zip(STEP_INPUTS, inputs, strict=True))
    planes = dict(zip(CONTACT_INPUTS, contacts, strict=True))
    batch, count = x.shape[0], nodes.shape[0]
    grad_x, grad_force, status = grad_x.contiguous(), grad_force.contiguous(), status.contiguous()
    require_sizes(ctx, batch, {**named, "x": x, "grad_x": grad_x})
    _require_contacts(ctx.num_vertices, batch, nodes, {**planes, "grad_force": grad_force})
    if tuple(status.shape) != (batch, count) or status.dtype != torch.int64:
        raise ValueError(
            f"status must be int64 of shape {(batch, count)}, got {status.dtype} of shape "
            f"{tuple(status.shape)}"
        )
    grads = gradient_buffers(named, STEP_GRADIENTS, batch)
    contact_grads = {name: torch.zeros_like(planes[name]) for name in CONTACT_GRADIENTS}
    stats = torch.zeros(batch, len(STATS), dtype=torch.float64)
    core.contact_step_adjoint(
        ctx.system(named, num_threads),
        pointers(**named),
        _contact_pointers(count, node=nodes, **planes),
        step_options(method, rtol, 0.0, max_iters),
        cache_columns,
        batch,
        x.data_ptr(),
        status.data_ptr(),
        grad_x.data_ptr(),
        grad_force.data_ptr(),
        pointers(**grads),
        _contact_pointers(count, **contact_grads),
        stats.data_ptr(),
        num_threads,
    )
    notify("adjoint", stats)
    report_failure(stats, "adjoint solve in contact", ADJOINT_HINT, on_failure)
    return [*sum_shared(grads), *contact_grads.values(), stats]


@contact_step_vjp.register_fake
def _(grad_x, grad_force, x, status, inputs, contacts, nodes, *args):
    like = [t for name, t in zip(STEP_INPUTS, inputs, strict=True) if name in STEP_GRADIENTS]
    like += contacts[: len(CONTACT_GRADIENTS)]
    return [*(torch.empty_like(t) for t in like), x.new_empty(x.shape[0], len(STATS))]


def _setup(ctx, inputs, output):
    tensors, contacts, nodes, ctx.handle, ctx.cache, ctx.method, *rest = inputs
    *_, ctx.num_threads, ctx.on_failure, ctx.rtol, ctx.iters = rest
    x, _force, status, stats = output
    ctx.save_for_backward(x, status, nodes, *tensors, *contacts)
    ctx.owner = context(ctx.handle)  # the graph keeps the prepared solver, if its body is deleted
    ctx.mark_non_differentiable(status, stats)


def _backward(ctx, grad_x, grad_force, _grad_status, _grad_stats):
    x, status, nodes, *rest = ctx.saved_tensors
    tensors, contacts = rest[: len(STEP_INPUTS)], rest[len(STEP_INPUTS) :]
    *grads, _stats = contact_step_vjp(
        grad_x, grad_force, x, status, tensors, contacts, nodes, ctx.handle, ctx.cache, ctx.method,
        ctx.rtol, ctx.iters, ctx.num_threads, ctx.on_failure,
    )  # fmt: skip
    split = len(STEP_GRADIENTS)
    named = dict(zip(STEP_GRADIENTS, grads[:split], strict=True))
    return [named.get(name) for name in STEP_INPUTS], [*grads[split:], None], *([None] * 11)


contact_step.register_autograd(_backward, setup_context=_setup)
