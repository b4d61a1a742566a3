"""The implicit step in contact and its adjoint, as torch custom ops.

Everything here has a leading batch axis and float64; the nodes in contact are shared by the batch.
The constant factor needs columns of its inverse in contact (thesis Alg. 5), multigrid does not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.layer import custom_op, make_first_order, make_layer
from diffsim.soft._arrays import ContactArrays, StepArrays, require_array
from diffsim.soft._context import (
    contact_addresses,
    context,
    require_upright,
    soft_addresses,
)
from diffsim.soft._ops_step import (
    ADJOINT_HINT,
    STEP_HINT,
    TANGENT_HINT,
    adjoint_arguments,
    new_stats,
    report_failure,
    require_step,
    step_options,
)
from diffsim.soft._solves import STATS, notify
from diffsim.soft._sticking import as_solved, let_slide, without_endless


def _require_contacts(
    num_nodes: int, batch: int, nodes: Tensor, contacts: list[Tensor]
) -> ContactArrays:
    """The arrays of the contacts, of the right sizes: kernels read whole arrays."""
    if nodes.dtype != torch.int64 or nodes.ndim != 1 or not nodes.is_contiguous():
        raise TypeError("contact nodes must be a contiguous int64 vector")
    count = nodes.shape[0]
    if count and (int(nodes.min()) < 0 or int(nodes.max()) >= num_nodes):
        raise ValueError(f"contact nodes must lie in [0, {num_nodes})")
    arrays = ContactArrays.of(contacts)
    arrays.require_sizes(batch, {"num_contacts": count})
    return arrays


@custom_op("diffsim::contact_step")
def contact_step(
    inputs: list[Tensor],
    contacts: list[Tensor],
    nodes: Tensor,
    *,
    handle: int,
    cache_columns: bool,
    method: str,
    preconditioner: str,
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
        inputs: Tensors of a :class:`StepArrays`.
        contacts: Tensors of a :class:`ContactArrays`.
        nodes: (num_contacts,) int64, no node twice.

    Returns:
        x, contact force (batch, num_contacts, 3), status (batch, num_contacts) int64, stats.
    """
    ctx = context(handle)
    batch, count = StepArrays.of(inputs).y.shape[0], nodes.shape[0]
    arrays = require_step(ctx, inputs, batch)
    planes = _require_contacts(ctx.num_nodes, batch, nodes, contacts)
    x = torch.empty_like(arrays.y)
    force = x.new_zeros(batch, count, 3)
    status = torch.zeros(batch, count, dtype=torch.int64)
    stats = new_stats(batch)
    while True:
        core.contact_step(
            system=ctx.system(arrays, num_threads, method, preconditioner, in_contact=True),
            inputs=soft_addresses(arrays.named()),
            contacts=contact_addresses(count, {"node": nodes, **planes.named()}),
            options=step_options(method, rtol=rtol, atol=atol, max_iters=max_iters),
            cache_columns=cache_columns,
            batch=batch,
            x=x.data_ptr(),
            force=force.data_ptr(),
            status=status.data_ptr(),
            stats=stats.data_ptr(),
            num_threads=num_threads,
        )
        notify("step", stats, max_iters, contact=True)
        require_upright(ctx, stats[:, STATS.index("energy")], x)  # the start where that failed
        report_failure(stats, "implicit step in contact", STEP_HINT, on_failure)
        again = let_slide(planes, force, stats[:, STATS.index("tolerance")])
        if again is None:
            break
        planes = again
    return x, force, status, stats


@contact_step.register_fake
def _(inputs, contacts, nodes, **_options):
    y = StepArrays.of(inputs).y
    batch, count = y.shape[0], nodes.shape[0]
    return (
        torch.empty_like(y),
        y.new_empty(batch, count, 3),
        y.new_empty(batch, count, dtype=torch.int64),
        y.new_empty(batch, len(STATS)),
    )


@custom_op("diffsim::contact_step_vjp")
def contact_step_vjp(
    grad_x: Tensor,
    grad_force: Tensor,
    x: Tensor,
    status: Tensor,
    inputs: list[Tensor],
    contacts: list[Tensor],
    nodes: Tensor,
    *,
    handle: int,
    cache_columns: bool,
    method: str,
    preconditioner: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> list[Tensor]:
    """Adjoint of :func:`contact_step`: gradients of both records' differentiable tensors, stats."""
    ctx = context(handle)
    batch, count = x.shape[0], nodes.shape[0]
    grad_x, grad_force, status = grad_x.contiguous(), grad_force.contiguous(), status.contiguous()
    arrays = require_step(ctx, inputs, batch, x=x, grad_x=grad_x)
    planes = _require_contacts(ctx.num_nodes, batch, nodes, contacts)
    solved = as_solved(planes, status)
    require_array("grad_force", grad_force, (batch, count, 3))
    if tuple(status.shape) != (batch, count) or status.dtype != torch.int64:
        raise ValueError(
            f"status must be int64 of shape {(batch, count)}, got {status.dtype} of shape "
            f"{tuple(status.shape)}"
        )
    grads = arrays.gradient_buffers(batch)
    contact_grads = planes.gradient_buffers(batch)
    stats = new_stats(batch)
    core.contact_step_adjoint(
        system=ctx.system(arrays, num_threads, method, preconditioner, in_contact=True),
        inputs=soft_addresses(arrays.named()),
        contacts=contact_addresses(count, {"node": nodes, **solved.named()}),
        options=step_options(method, rtol=rtol, max_iters=max_iters),
        cache_columns=cache_columns,
        batch=batch,
        x=x.data_ptr(),
        status=status.data_ptr(),
        grad_x=grad_x.data_ptr(),
        grad_force=grad_force.data_ptr(),
        grads=soft_addresses(grads),
        contact_grads=contact_addresses(count, contact_grads),
        stats=stats.data_ptr(),
        num_threads=num_threads,
    )
    notify("adjoint", stats, max_iters, contact=True)
    report_failure(stats, "adjoint solve in contact", ADJOINT_HINT, on_failure)
    contact_grads["friction"] = without_endless(planes, contact_grads["friction"])
    return [*arrays.summed(grads), *planes.summed(contact_grads), stats]


@contact_step_vjp.register_fake
def _(grad_x, grad_force, x, status, inputs, contacts, nodes, **_options):
    like = [
        *StepArrays.of(inputs).empty_gradients(),
        *ContactArrays.of(contacts).empty_gradients(),
    ]
    return [*like, x.new_empty(x.shape[0], len(STATS))]


def _setup(ctx, inputs, keyword_only_inputs, output):
    tensors, contacts, nodes = inputs
    ctx.arguments = adjoint_arguments(keyword_only_inputs)
    ctx.arguments["cache_columns"] = keyword_only_inputs["cache_columns"]
    x, _force, status, stats = output
    ctx.save_for_backward(x, status, nodes, *tensors, *contacts)
    ctx.owner = context(ctx.arguments["handle"])  # keeps the prepared solver of a deleted body
    ctx.mark_non_differentiable(status, stats)


def _backward(ctx, grad_x, grad_force, _grad_status, _grad_stats):
    x, status, nodes, *rest = ctx.saved_tensors
    tensors, contacts = rest[: len(StepArrays.specs)], rest[len(StepArrays.specs) :]
    *grads, _stats = contact_step_vjp_layer(
        grad_x, grad_force, x, status, tensors, contacts, nodes, **ctx.arguments
    )
    split = len(StepArrays.differentiable())
    return (
        StepArrays.all_gradients(grads[:split]),
        ContactArrays.all_gradients(grads[split:]),
        None,
    )


@custom_op("diffsim::contact_step_jvp")
def contact_step_jvp(
    x: Tensor,
    status: Tensor,
    inputs: list[Tensor],
    contacts: list[Tensor],
    nodes: Tensor,
    directions: list[Tensor],
    contact_directions: list[Tensor],
    *,
    handle: int,
    cache_columns: bool,
    method: str,
    preconditioner: str,
    rtol: float,
    max_iters: int,
    num_threads: int,
    on_failure: str,
) -> tuple[Tensor, Tensor]:
    """Positions and contact forces along one direction, for every item of the batch.

    Args:
        x, status: Answers of :func:`contact_step`.
        inputs: Tensors of a :class:`StepArrays`.
        contacts: Tensors of a :class:`ContactArrays`.
        nodes: (num_contacts,) int64.
        directions, contact_directions: Tangents in the order of ``inputs`` and ``contacts``; an
            empty tensor where one does not move.

    Returns:
        (batch, num_nodes, 3), (batch, num_contacts, 3).
    """
    ctx = context(handle)
    batch, count = x.shape[0], nodes.shape[0]
    x, status = x.contiguous(), status.contiguous()
    arrays = require_step(ctx, inputs, batch, x=x)
    planes = _require_contacts(ctx.num_nodes, batch, nodes, contacts)
    moved = arrays.moving(directions)
    planes_moved = planes.moving(contact_directions)
    if "friction" in planes_moved:
        planes_moved["friction"] = without_endless(planes, planes_moved["friction"])
    planes = as_solved(planes, status)
    dx, dforce = torch.empty_like(x), x.new_empty(batch, count, 3)
    stats = new_stats(batch)
    for k in range(batch):
        core.contact_step_tangent(
            system=ctx.system(arrays, num_threads, method, preconditioner, in_contact=True),
            inputs=soft_addresses(arrays.item(k)),
            contacts=contact_addresses(count, {"node": nodes, **planes.item(k)}),
            options=step_options(method, rtol=rtol, max_iters=max_iters),
            cache_columns=cache_columns,
            x=x[k].data_ptr(),
            status=status[k].data_ptr(),
            directions=soft_addresses(arrays.item_of(moved, k)),
            contact_directions=contact_addresses(count, planes.item_of(planes_moved, k)),
            dx=dx[k].data_ptr(),
            dforce=dforce[k].data_ptr(),
            stats=stats[k].data_ptr(),
            num_threads=num_threads,
        )
    notify("tangent", stats, max_iters, contact=True)
    report_failure(stats, "tangent solve in contact", TANGENT_HINT, on_failure)
    return dx, dforce


@contact_step_jvp.register_fake
def _(x, status, inputs, contacts, nodes, directions, contact_directions, **_options):
    return torch.empty_like(x), x.new_empty(x.shape[0], nodes.shape[0], 3)


def _tangent(ctx, moved, contacts_moved, _nodes):
    x, status, nodes, *rest = ctx.saved_tensors
    tensors, contacts = rest[: len(StepArrays.specs)], rest[len(StepArrays.specs) :]
    dx, dforce = contact_step_jvp_layer(
        x,
        status,
        tensors,
        contacts,
        nodes,
        StepArrays.directions(moved, x),
        ContactArrays.directions(contacts_moved, x),
        **ctx.arguments,
    )
    return dx, dforce, None, None


contact_step_vjp_layer = make_first_order(contact_step_vjp)
contact_step_jvp_layer = make_first_order(contact_step_jvp)
contact_step_layer = make_layer(contact_step, setup=_setup, backward=_backward, tangent=_tangent)
