"""Formulas as tapes for the kernel: instructions on registers, equal parts computed once.

Registers: time, states, inputs, parameters, constants, then one for each instruction
(``csrc/kernels/ode/tape.h``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.expression import OPERATIONS, Apply, Expression, Name, Node, Number

_CODES = {name: code for code, name in enumerate(OPERATIONS)}  # in the order of TapeOp


@dataclass(frozen=True, eq=False)
class Tapes:
    """Several groups of formulas on the same given registers.

    Attributes:
        constants: Values of the constant registers, (num_constants,) float64.
        code: For each group its instructions, (num_code, 4) int64: operation, a, b, c.
        outputs: For each group the registers of its formulas, (num_formulas,) int64.
    """

    constants: Tensor
    code: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]


def make_tapes(names: Sequence[str], groups: Sequence[Sequence[Expression]]) -> Tapes:
    """Tapes of groups of formulas.

    Args:
        names: Of the given registers in their order: time, states, inputs, parameters.
        groups: Formulas of these names; each group becomes a tape of its own.
    """
    constants: dict[float, int] = {}
    for group in groups:
        for formula in group:
            _collect(formula.root, constants)
    num_given = len(names) + len(constants)
    place = {name: i for i, name in enumerate(names)}
    number = {value: len(names) + i for value, i in constants.items()}
    code, outputs = [], []
    for group in groups:
        known: dict[Node, int] = {}
        rows: list[list[int]] = []
        found = [_emit(f.root, known, rows, place, number, num_given) for f in group]
        code.append(torch.tensor(rows, dtype=torch.int64).reshape(-1, 4))
        outputs.append(torch.tensor(found, dtype=torch.int64))
    return Tapes(torch.tensor(list(constants), dtype=torch.float64), tuple(code), tuple(outputs))


def _collect(node: Node, constants: dict[float, int]) -> None:
    if isinstance(node, Number):
        constants.setdefault(node.value, len(constants))
    elif isinstance(node, Apply):
        for part in node.parts:
            _collect(part, constants)


def _emit(
    node: Node,
    known: dict[Node, int],
    rows: list[list[int]],
    place: dict[str, int],
    number: dict[float, int],
    num_given: int,
) -> int:
    """Register of a part; instructions that it needs are added to ``rows``."""
    if isinstance(node, Number):
        return number[node.value]
    if isinstance(node, Name):
        return place[node.name]
    if node not in known:
        parts = [_emit(part, known, rows, place, number, num_given) for part in node.parts]
        rows.append([_CODES[node.operation], *parts, *([0] * (3 - len(parts)))])
        known[node] = num_given + len(rows) - 1
    return known[node]
