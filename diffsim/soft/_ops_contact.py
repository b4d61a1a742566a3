"""The implicit step in contact and its derivatives as an op.

The nodes in contact are shared by the batch. The constant factor needs columns of its inverse in
contact (thesis Alg. 5), multigrid does not.

Steps that infinite friction leaves without an answer are solved again: their nodes may slide.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.errors import ContactWarning
from diffsim.core.ops import Call, Op, array
from diffsim.core.record import warn
from diffsim.soft._arrays import CONTACTS, NODAL, ContactArrays, StepArrays
from diffsim.soft._context import (
    contact_addresses,
    context_of,
    owner,
    require_upright,
    sizes_of_call,
    soft_addresses,
)
from diffsim.soft._ops_step import (
    OPTIONS,
    STATS_ARRAY,
    STEP_HINT,
    finish,
    new_stats,
    report_failure,
    step_options,
    system_of,
)
from diffsim.soft._solves import STATS, notify


def _sizes(call: Call) -> dict[str, Any]:
    return sizes_of_call(call) | {"num_contacts": call["nodes"].shape[0]}


def _contacts(call: Call) -> ContactArrays:
    nodes, num_nodes = call["nodes"], call.sizes["num_nodes"]
    if nodes.numel() and (int(nodes.min()) < 0 or int(nodes.max()) >= num_nodes):
        raise ValueError(f"contact nodes must lie in [0, {num_nodes})")
    return ContactArrays.of(call)


def _places(call: Call, planes: Mapping[str, Tensor]) -> object:
    return contact_addresses(call.sizes["num_contacts"], {"node": call["nodes"], **planes})


def _step(call: Call) -> None:
    options, arrays, planes = call.options, StepArrays.of(call), _contacts(call)
    ctx, stats, force = context_of(call), call["stats"], call["contact_force"]
    tolerances = {name: options[name] for name in ("rtol", "atol", "max_iters")}
    while True:
        core.contact_step(
            **system_of(call, in_contact=True)
            | {"options": step_options(options["method"], **tolerances)},
            inputs=soft_addresses(arrays.named()),
            contacts=_places(call, planes.named()),
            cache_columns=options["cache_columns"],
            batch=call.sizes["batch"],
            **call.addresses("x", "status", "stats"),
            force=force.data_ptr(),
        )
        notify("step", stats, options["max_iters"], contact=True)
        # x is the start where that failed
        require_upright(ctx, stats[:, STATS.index("energy")], call["x"])
        report_failure(stats, "implicit step in contact", STEP_HINT, options["on_failure"])
        again = let_slide(planes, force, stats[:, STATS.index("tolerance")])
        if again is None:
            return
        planes = again


def _adjoint(call: Call) -> None:
    arrays, planes = StepArrays.of(call), _contacts(call)
    batch, stats = call.sizes["batch"], new_stats(call.sizes["batch"])
    by_planes = planes.gradients(call)
    core.contact_step_adjoint(
        **system_of(call, in_contact=True),
        inputs=soft_addresses(arrays.named()),
        contacts=_places(call, as_solved(planes, call["status"]).named()),
        cache_columns=call.options["cache_columns"],
        batch=batch,
        **call.addresses("x", "status", "grad_x"),
        grad_force=call["grad_contact_force"].data_ptr(),
        grads=soft_addresses(arrays.gradients(call)),
        contact_grads=contact_addresses(call.sizes["num_contacts"], by_planes),
        stats=stats.data_ptr(),
    )
    finish(call, "adjoint", stats, " in contact")
    arrays.add_gradients(call)
    call["grad_friction"] = without_endless(planes, by_planes["friction"])


def _tangent(call: Call) -> None:
    arrays, planes = StepArrays.of(call), _contacts(call)
    moved, planes_moved = arrays.moved(call), planes.moved(call)
    if "friction" in planes_moved:
        planes_moved["friction"] = without_endless(planes, planes_moved["friction"])
    planes = as_solved(planes, call["status"])
    stats, count = new_stats(call.sizes["batch"]), call.sizes["num_contacts"]
    for k in range(len(stats)):
        core.contact_step_tangent(
            **system_of(call, in_contact=True),
            inputs=soft_addresses(arrays.item(k)),
            contacts=_places(call, planes.item(k)),
            cache_columns=call.options["cache_columns"],
            **{name: call[name][k].data_ptr() for name in ("x", "status")},
            directions=soft_addresses(arrays.item_of(moved, k)),
            contact_directions=contact_addresses(count, planes.item_of(planes_moved, k)),
            dx=call["d_x"][k].data_ptr(),
            dforce=call["d_contact_force"][k].data_ptr(),
            stats=stats[k].data_ptr(),
        )
    finish(call, "tangent", stats, " in contact")


contact_step = Op(  # one step of a batch in contact; csrc/kernels/soft/contact/contact_step.h
    "contact_step",
    inputs={
        **StepArrays.specs,
        **ContactArrays.specs,
        "nodes": array("num_contacts", dtype=torch.int64, smooth=False),  # no node twice
    },
    outputs={
        "x": array(*NODAL),
        "contact_force": array(*CONTACTS, 3, zeroed=True),
        "status": array(*CONTACTS, dtype=torch.int64, smooth=False, zeroed=True),
        "stats": STATS_ARRAY,
    },
    options=f"int handle, bool cache_columns, {OPTIONS}",
    sizes=_sizes,
    owner=owner,
    reads=("x", "status", *StepArrays.specs, *ContactArrays.specs, "nodes"),
    kernel=_step,
    adjoint=_adjoint,
    tangent=_tangent,
    skips_still=True,
)


SLIDING_FRICTION = 2.0
"""Coefficient in a step that infinite friction leaves without an answer [-]: in 300 landings no
such step failed with 1 to 3, with 5 two of 406."""
_SLIP = 2


def let_slide(planes: ContactArrays, force: Tensor, tolerance: Tensor) -> ContactArrays | None:
    """Half spaces to solve a step with once more, because an obstacle pulls; None: none does.

    With infinite friction a touching node may have no answer: it is pulled off where it sticks,
    and slides into the obstacle where it is let go. A finite coefficient always has an answer. All
    such contacts of the body take it: beside one that cannot slide there may again be none.

    Args:
        force: Forces on the nodes, (batch, num_contacts, 3) [N].
        tolerance: Norm of the residual that the step had to reach, (batch,) [N].
    """
    endless = torch.isinf(planes.friction)
    if not bool(endless.any()):
        return None
    pressing = (planes.normal * force).sum(-1)
    pulling = endless & (pressing < -tolerance[:, None])
    count = int(pulling.sum())
    if not count:
        return None
    warn(
        f"friction=inf leaves {count} nodes without an answer: stuck they are pulled off, let go "
        f"they slide into the obstacle; this step is solved with friction {SLIDING_FRICTION:g}",
        ContactWarning,
        stacklevel=3,
    )
    again = endless & pulling.any(-1, keepdim=True)
    friction = torch.where(again, SLIDING_FRICTION, planes.friction)
    return dataclasses.replace(planes, friction=friction)


def without_endless(planes: ContactArrays, by_friction: Tensor) -> Tensor:
    """Derivatives by friction, or its directions: zero where the coefficient is infinite."""
    return by_friction.masked_fill(torch.isinf(planes.friction), 0.0)


def as_solved(planes: ContactArrays, status: Tensor) -> ContactArrays:
    """Half spaces of a solved step: what slides has no infinite friction (:func:`let_slide`)."""
    sliding = torch.isinf(planes.friction) & (status == _SLIP)
    if not bool(sliding.any()):
        return planes
    friction = torch.where(sliding, SLIDING_FRICTION, planes.friction)
    return dataclasses.replace(planes, friction=friction)
