"""Formulas as a tape for the kernel: instructions on registers, equal parts computed once.

Registers: time, states, inputs, parameters, constants, then one for each instruction. Instructions
stand in parts by what they need, so that none is computed again before that changes
(``csrc/kernels/ode/tape.h``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.expression import OPERATIONS, Apply, Expression, Name, Node, NumberNode

TAPE_OPERATIONS = OPERATIONS | {
    "mul_add": lambda a, b, c: a * b + c,
    "mul_sub": lambda a, b, c: a * b - c,
    "sub_mul": lambda a, b, c: c - a * b,
}
"""What instructions do, in the order of TapeOp."""
_CODES = {name: code for code, name in enumerate(TAPE_OPERATIONS)}
_COMMUTE = ("add", "mul")
_FUSED = {_CODES["add"]: ("mul_add", "mul_add"), _CODES["sub"]: ("mul_sub", "sub_mul")}
_QUICK_POWERS = (0.5, 2.0, 3.0)  # as torch.pow has them: a root, or products of equal bits
_FIXED, _DRIVEN, _MOVING, _READINGS = range(4)  # parts of a tape
_PARTS = {"time": _DRIVEN, "input": _DRIVEN, "state": _MOVING}


@dataclass(frozen=True, eq=False)
class Tape:
    """Formulas of rates and of readings on the same registers."""

    constants: Tensor  # values of the constant registers, (num_constants,) float64
    code: Tensor  # instructions, (num_code, 4) int64: operation, a, b, c
    # (4,) int64, where parts of the code end: what needs parameters alone; for the rates, what
    # needs time and inputs besides, then all else; what only readings need
    ends: Tensor
    rates: Tensor  # registers of the rates, (num_rates,) int64
    readings: Tensor  # registers of the readings, (num_readings,) int64


def make_tape(
    names: Mapping[str, str], rates: Sequence[Expression], readings: Sequence[Expression]
) -> Tape:
    """The tape of a system's formulas.

    Args:
        names: Given registers in their order, and what each is: "time", "state", "input" or
            "parameter".
    """
    writer, num_names = _Writer(names), len(names)
    found = [writer.register(f.root) for f in rates]
    num_needed = len(writer.rows)
    found += [writer.register(f.root) for f in readings]
    parts = {i: _PARTS.get(kind, _FIXED) for i, kind in enumerate(names.values())}
    parts |= dict.fromkeys(writer.constants.values(), _FIXED)
    for i, row in enumerate(writer.rows):
        part = max(parts[k] for k in row[1:])
        parts[num_names + i] = _READINGS if part and i >= num_needed else part
    rows = _fuse(writer.rows, parts, num_names, found)
    depth = dict.fromkeys(parts, 0)
    for k in rows:
        depth[k] = 1 + max((depth[o] for o in rows[k][1:] if parts[o] == parts[k]), default=0)
    order = sorted(rows, key=lambda k: (parts[k], depth[k], rows[k][0]))
    given = [*range(num_names), *writer.constants.values()]
    new = {old: i for i, old in enumerate([*given, *order])}
    code = [[rows[k][0], *(new[operand] for operand in rows[k][1:])] for k in order]
    padded = [row + [0] * (4 - len(row)) for row in code]
    counts = Counter(parts[k] for k in order)
    outputs = torch.tensor([new[k] for k in found], dtype=torch.int64)
    return Tape(
        torch.tensor(list(writer.constants), dtype=torch.float64),
        torch.tensor(padded, dtype=torch.int64).reshape(-1, 4),
        torch.tensor([counts[part] for part in range(4)], dtype=torch.int64).cumsum(0),
        outputs[: len(rates)],
        outputs[len(rates) :],
    )


def _fuse(
    rows: Sequence[Sequence[int]], parts: Mapping[int, int], num_names: int, outputs: Sequence[int]
) -> dict[int, Sequence[int]]:
    """Instructions by their registers; a product that one sum alone asks for is part of it.

    A sum of two products stays as it is: products that are equal then cancel to zero.
    """
    written = dict(enumerate(rows, num_names))
    uses = Counter([*(k for row in rows for k in row[1:]), *outputs])
    for register, (code, *operands) in list(written.items()):
        if code not in _FUSED:
            continue
        products = [k in written and written[k][0] == _CODES["mul"] for k in operands]
        if sum(products) != 1:
            continue
        place = products.index(True)
        product, other = operands[place], operands[1 - place]
        if uses[product] == 1 and parts[product] == parts[register]:
            fused = _FUSED[code][place]
            written[register] = [_CODES[fused], *written.pop(product)[1:], other]
    return written


class _Writer:
    """Instructions in the order of formulas; what is equal, or one object, is computed once.

    Registers of constants are below 0: how many there are shows at the end.
    """

    def __init__(self, names: Iterable[str]):
        self._place = {name: i for i, name in enumerate(names)}
        self._known: dict[tuple[int, ...], int] = {}  # instruction -> its register
        self._visited: dict[int, int] = {}  # id of a part -> its register
        self.constants: dict[float, int] = {}  # value -> its register
        self.rows: list[list[int]] = []

    def register(self, node: Node) -> int:
        """Register of a part; instructions that it needs are added to ``rows``."""
        if isinstance(node, NumberNode):
            return self.constants.setdefault(node.value, -1 - len(self.constants))
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
        row = [_CODES[operation], *(sorted(registers) if operation in _COMMUTE else registers)]
        if tuple(row) not in self._known:
            self.rows.append(row)
            num_given = len(self._place)
            self._known[tuple(row)] = num_given + len(self.rows) - 1
        return self._known[tuple(row)]
