"""Initial value problems as an op; see ``csrc/kernels/ode/integrate.h``.

Only what differentiates a derivative takes the steps in PyTorch's own operations: it may be
differentiated as often as one likes, and takes thousands of times longer than the kernel (a product
with the Hessian over 500 steps of two states: 2 s).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from diffsim.core.compiled import core
from diffsim.core.ops import Call, Given, Op, array
from diffsim.ode.tape import TAPE_OPERATIONS

CONSTANT = {"dtype": torch.int64, "smooth": False}
PROBLEM = {
    "code": array("num_code", 4, **CONSTANT),
    "ends": array(4, **CONSTANT),
    "rate_out": array("num_states", **CONSTANT),
    "reading_out": array("num_channels", **CONSTANT),
    "constants": array("num_constants", smooth=False),
    "times": array("batch?", "num_samples", smooth=False),
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
    for name in ("input", "time"):  # what all members share has one row
        rows = call[f"{name}s"]
        setattr(p, f"{name}_stride", 0 if len(rows) == 1 else rows[0].numel())
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
        "start": array("batch", "num_states"),
        **PROBLEM,
        "inputs": array("batch?", "num_samples", "num_inputs"),
        "parameters": array("batch", "num_parameters"),
    },
    outputs={
        "readings": array("batch", "num_samples", "num_channels"),
        "states": array("batch", "num_samples", "num_states"),
    },
    options="int num_steps, int num_threads",
    reads=("start", *PROBLEM, "inputs", "parameters", "states"),
    kernel=_integrate,
    adjoint=_adjoint,
    tangent=_tangent,
    in_torch=_in_torch,
)


_SHARES = (0.0, 0.5, 0.5, 1.0)
_WEIGHTS = (1.0, 2.0, 2.0, 1.0)
_APPLY = tuple(TAPE_OPERATIONS.values())
_TAKES = dict.fromkeys(("where", "mul_add", "mul_sub", "sub_mul"), 3) | dict.fromkeys(
    ("add", "sub", "mul", "div", "pow", "less", "less_equal", "min", "max", "atan2", "hypot"), 2
)
_COUNTS = tuple(_TAKES.get(name, 1) for name in TAPE_OPERATIONS)


def solve(
    problem: Mapping[str, Tensor], num_steps: int, start: Tensor, inputs: Tensor, parameters: Tensor
) -> tuple[Tensor, Tensor]:
    """Readings and states as ``ode_integrate`` gives them; arguments as there."""
    times, lower, upper = problem["times"], problem["lower"], problem["upper"]
    moves = 1.0 - problem["held"].double()  # those that are held stay until the next sample
    constants, code = list(problem["constants"]), problem["code"].tolist()
    ends = {"rate": int(problem["ends"][2]), "reading": len(code)}

    def evaluate(what: str, time: Tensor, x: Tensor, u: Tensor) -> Tensor:
        given = [time.expand(len(x)), *x.unbind(-1), *u.unbind(-1), *parameters.unbind(-1)]
        registers = [*given, *(c.expand(len(x)) for c in constants)]
        for operation, *operands in code[: ends[what]]:
            taken = [registers[k] for k in operands[: _COUNTS[operation]]]
            registers.append(_APPLY[operation](*taken))
        rows = [registers[k] for k in problem[f"{what}_out"].tolist()]
        return torch.stack(rows, -1) if rows else x[:, :0]

    def advance(k: int, j: int, x: Tensor) -> Tensor:
        width = ((times[:, k + 1] - times[:, k]) / num_steps)[:, None]
        rates: list[Tensor] = []
        for share in _SHARES:
            at = (j + share) / num_steps
            u = inputs[:, k] + at * moves * (inputs[:, k + 1] - inputs[:, k])
            stage = x + share * width * rates[-1] if rates else x
            time = times[:, k] + at * (times[:, k + 1] - times[:, k])
            rates.append(evaluate("rate", time, stage, u.expand(len(x), -1)))
        end = x + width / 6.0 * sum(w * rate for w, rate in zip(_WEIGHTS, rates, strict=True))
        return torch.where(end < lower, lower, torch.where(end > upper, upper, end))

    readings, states, x = [], [], start
    num_samples = times.shape[1]
    for k in range(num_samples):
        states.append(x)
        readings.append(evaluate("reading", times[:, k], x, inputs[:, k].expand(len(x), -1)))
        for j in range(num_steps if k + 1 < num_samples else 0):
            x = advance(k, j, x)
    return torch.stack(readings, 1), torch.stack(states, 1)
