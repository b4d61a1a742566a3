"""Initial value problems as an op; see ``csrc/kernels/ode/integrate.h``."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Given, Op, array
from diffsim.ode.in_torch import solve

CONSTANT = {"dtype": torch.int64, "smooth": False}
PROBLEM = {
    "code": array("num_code", 4, **CONSTANT),
    "ends": array(4, **CONSTANT),
    "rate_out": array("num_states", **CONSTANT),
    "reading_out": array("num_channels", **CONSTANT),
    "constants": array("num_constants", smooth=False),
    "times": array("num_samples", smooth=False),
    "lower": array("num_states", smooth=False),
    "upper": array("num_states", smooth=False),
    "held": array("num_inputs", **CONSTANT),
}
"""What describes a problem, by the names that the kernel has for it."""
SIZES = (
    *("num_code", "num_states", "num_inputs", "num_parameters"),
    *("num_constants", "num_channels", "num_samples", "num_steps", "batch"),
)


def _problem(call: Call) -> Any:
    p = core.OdeAddresses()
    for name, value in (call.addresses(*PROBLEM) | {n: call.sizes[n] for n in SIZES}).items():
        setattr(p, name, value)
    inputs = call["inputs"]
    p.input_stride = 0 if len(inputs) == 1 else inputs[0].numel()
    return p


def _others(call: Call, *but: str) -> dict[str, int]:
    """Where all but the problem lies."""
    places = call.addresses(*(name for name in call if name not in (*PROBLEM, *but)))
    return places | {"num_threads": call.sizes["num_threads"]}


def _integrate(call: Call) -> None:
    core.ode_integrate(_problem(call), **_others(call))


def _adjoint(call: Call) -> None:
    inputs = call["inputs"]
    call["grad_inputs"] = inputs.new_zeros(call.sizes["batch"], *inputs.shape[1:])
    core.ode_integrate_vjp(_problem(call), **_others(call, "start"))
    if len(inputs) == 1:
        call["grad_inputs"] = call["grad_inputs"].sum(0, keepdim=True)


def _tangent(call: Call) -> None:
    core.ode_integrate_tangent(_problem(call), **_others(call, "states"))


def _in_torch(given: Given) -> tuple[Tensor, Tensor]:
    problem = {name: given[name] for name in PROBLEM}
    moving = (given[name] for name in ("start", "inputs", "parameters"))
    return solve(problem, given["num_steps"], *moving)


ode_integrate = Op(
    "ode_integrate",
    inputs={
        **PROBLEM,
        "start": array("batch", "num_states"),
        "inputs": array("batch?", "num_samples", "num_inputs"),
        "parameters": array("batch", "num_parameters"),
    },
    outputs={
        "readings": array("batch", "num_samples", "num_channels"),
        "states": array("batch", "num_samples", "num_states"),
    },
    options="int num_steps, int num_threads",
    reads=(*PROBLEM, "start", "inputs", "parameters", "states"),
    kernel=_integrate,
    adjoint=_adjoint,
    tangent=_tangent,
    in_torch=_in_torch,
)
