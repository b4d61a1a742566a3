"""The same steps as the kernel's in PyTorch's own operations, for derivatives of higher order.

Only what differentiates a derivative comes here: it may be differentiated as often as one likes,
and takes thousands of times longer than the kernel (a product with the Hessian over 500 steps of
two states: 2 s).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from diffsim.ode.tape import TAPE_OPERATIONS

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
        width = (times[k + 1] - times[k]) / num_steps
        rates: list[Tensor] = []
        for share in _SHARES:
            at = (j + share) / num_steps
            u = inputs[:, k] + at * moves * (inputs[:, k + 1] - inputs[:, k])
            stage = x + share * width * rates[-1] if rates else x
            time = times[k] + at * (times[k + 1] - times[k])
            rates.append(evaluate("rate", time, stage, u.expand(len(x), -1)))
        end = x + width / 6.0 * sum(w * rate for w, rate in zip(_WEIGHTS, rates, strict=True))
        return torch.where(end < lower, lower, torch.where(end > upper, upper, end))

    readings, states, x = [], [], start
    for k in range(len(times)):
        states.append(x)
        readings.append(evaluate("reading", times[k], x, inputs[:, k].expand(len(x), -1)))
        for j in range(num_steps if k + 1 < len(times) else 0):
            x = advance(k, j, x)
    return torch.stack(readings, 1), torch.stack(states, 1)
