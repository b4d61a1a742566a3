"""Formulas as tapes for the kernel: instructions on registers, equal parts computed once.

Registers: time, states, inputs, parameters, constants, then one for each instruction
(``csrc/kernels/ode/tape.h``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.expression import OPERATIONS, Apply, Expression, Name, Node, NumberNode

_CODES = {name: code for code, name in enumerate(OPERATIONS)}  # in the order of TapeOp
_QUICK_POWERS = (0.5, 2.0, 3.0)  # as torch.pow has them: a root, or products of equal bits


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
    seen: set[int] = set()
    for group in groups:
        for formula in group:
            _collect(formula.root, constants, seen)
    place = {name: i for i, name in enumerate(names)}
    place_of_number = {value: len(names) + i for value, i in constants.items()}
    code, outputs = [], []
    for group in groups:
        tape = _Writer(place, place_of_number)
        found = [tape.register(f.root) for f in group]
        code.append(torch.tensor(tape.rows, dtype=torch.int64).reshape(-1, 4))
        outputs.append(torch.tensor(found, dtype=torch.int64))
    return Tapes(torch.tensor(list(constants), dtype=torch.float64), tuple(code), tuple(outputs))


def _collect(node: Node, constants: dict[float, int], seen: set[int]) -> None:
    if isinstance(node, NumberNode):
        constants.setdefault(node.value, len(constants))
    elif isinstance(node, Apply) and id(node) not in seen:
        seen.add(id(node))
        for part in node.parts:
            _collect(part, constants, seen)


class _Writer:
    """Instructions of one tape; parts that are equal, or the same object, are computed once."""

    def __init__(self, place: dict[str, int], number: dict[float, int]):
        self._place, self._number = place, number
        self._known: dict[tuple[int, ...], int] = {}  # instruction -> its register
        self._visited: dict[int, int] = {}  # id of a part -> its register
        self.rows: list[list[int]] = []

    def register(self, node: Node) -> int:
        """Register of a part; instructions that it needs are added to ``rows``."""
        if isinstance(node, NumberNode):
            return self._number[node.value]
        if isinstance(node, Name):
            return self._place[node.name]
        if id(node) not in self._visited:
            self._visited[id(node)] = self._apply(node)
        return self._visited[id(node)]

    def _apply(self, node: Apply) -> int:
        power = node.parts[1] if node.operation == "pow" else None
        if isinstance(power, NumberNode) and power.value in _QUICK_POWERS:
            base = self.register(node.parts[0])
            if power.value == 0.5:
                return self._instruction("sqrt", base)
            square = self._instruction("mul", base, base)
            return square if power.value == 2.0 else self._instruction("mul", square, base)
        return self._instruction(node.operation, *map(self.register, node.parts))

    def _instruction(self, operation: str, *registers: int) -> int:
        """Register of an operation on registers; written down where it is new."""
        row = [_CODES[operation], *registers, *([0] * (3 - len(registers)))]
        if tuple(row) not in self._known:
            self.rows.append(row)
            num_given = len(self._place) + len(self._number)
            self._known[tuple(row)] = num_given + len(self.rows) - 1
        return self._known[tuple(row)]
