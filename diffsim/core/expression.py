"""Formulas as text: parsed once, evaluated on tensors, never run as code.

A formula is one expression of numbers, names, ``+ - * / **``, comparisons, ``and or not``,
``a if condition else b`` and the functions of ``FUNCTIONS``. Anything else is refused when it is
parsed, with the column at which it stands.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from diffsim.core.check import did_you_mean

Values = Mapping[str, Tensor]
_Node = Callable[[Values], Tensor]

MAX_LENGTH = 2000  # characters: longer text is a program, not a formula
MAX_DEPTH = 40  # nested brackets; the parser itself recurses

CONSTANTS = {"pi": math.pi, "e": math.e}


def _where(condition: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    return torch.where(condition != 0.0, yes, no)


def _clip(x: Tensor, low: Tensor, high: Tensor) -> Tensor:
    return torch.minimum(torch.maximum(x, low), high)


FUNCTIONS: dict[str, tuple[int, Callable[..., Tensor]]] = {
    "abs": (1, torch.abs),
    "acos": (1, torch.acos),
    "asin": (1, torch.asin),
    "asinh": (1, torch.asinh),
    "atan": (1, torch.atan),
    "atan2": (2, torch.atan2),
    "clip": (3, _clip),
    "cos": (1, torch.cos),
    "cosh": (1, torch.cosh),
    "exp": (1, torch.exp),
    "hypot": (2, torch.hypot),
    "log": (1, torch.log),
    "max": (2, torch.maximum),
    "min": (2, torch.minimum),
    "sign": (1, torch.sign),
    "sin": (1, torch.sin),
    "sinh": (1, torch.sinh),
    "sqrt": (1, torch.sqrt),
    "tan": (1, torch.tan),
    "tanh": (1, torch.tanh),
    "where": (3, _where),
}
"""Name -> number of arguments, and what it does."""

_BINARY: dict[type[ast.operator], Callable[[Tensor, Tensor], Tensor]] = {
    ast.Add: torch.add,
    ast.Sub: torch.sub,
    ast.Mult: torch.mul,
    ast.Div: torch.div,
    ast.Pow: torch.pow,
}
_COMPARE: dict[type[ast.cmpop], Callable[[Tensor, Tensor], Tensor]] = {
    ast.Lt: torch.lt,
    ast.LtE: torch.le,
    ast.Gt: torch.gt,
    ast.GtE: torch.ge,
}


@dataclass(frozen=True)
class Expression:
    """A parsed formula; call it with values by name.

    Attributes:
        text: As it was written.
        names: Quantities that it needs, in order of appearance.
    """

    text: str
    names: tuple[str, ...]
    _root: _Node = field(repr=False, compare=False)

    def __call__(self, values: Values) -> Tensor:
        """Value of the formula, float64, of the shape that its quantities broadcast to.

        Args:
            values: Quantities by name, float64 tensors that broadcast; more than needed is allowed.
        """
        return self._root(values)


def parse_expression(text: str | float, known: Iterable[str] | None = None) -> Expression:
    """Parse a formula.

    Args:
        text: Such as ``"k * x + c * tanh(v / 0.01)"``; a plain number is a constant formula.
        known: Names that may stand in it; any if None.

    Returns:
        The formula.

    Raises:
        ValueError: not a formula, or an unknown name; the message shows the column and what was
            meant by the closest names.
    """
    text = str(text).strip()
    if len(text) > MAX_LENGTH:
        raise ValueError(f"a formula may have {MAX_LENGTH} characters, got {len(text)}")
    try:
        tree = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        at = f" at column {error.offset}" if isinstance(error, SyntaxError) else ""
        why = error.msg if isinstance(error, SyntaxError) else "nested too deeply"
        raise ValueError(f"formula {text!r} cannot be read{at}: {why}") from None
    parser = _Parser(text, None if known is None else tuple(known))
    root = parser.node(tree, 0)
    return Expression(text, tuple(parser.names), root)


class _Parser:
    """One walk over a syntax tree; collects the names that it meets."""

    def __init__(self, text: str, known: tuple[str, ...] | None):
        self.text, self.known = text, known
        self.names: dict[str, None] = {}

    def node(self, node: ast.expr, depth: int) -> _Node:
        """A function of the values for one part of the formula."""
        if depth > MAX_DEPTH:
            raise self.error(node, f"is nested more than {MAX_DEPTH} deep")
        below = depth + 1
        if isinstance(node, ast.Constant):
            return self.constant(node)
        if isinstance(node, ast.Name):
            return self.name(node)
        if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            apply = _BINARY[type(node.op)]
            left, right = self.node(node.left, below), self.node(node.right, below)
            return lambda v: apply(left(v), right(v))
        if isinstance(node, ast.UnaryOp):
            return self.unary(node, below)
        if isinstance(node, ast.Call):
            return self.call(node, below)
        if isinstance(node, ast.Compare):
            return self.compare(node, below)
        if isinstance(node, ast.BoolOp):
            join = torch.minimum if isinstance(node.op, ast.And) else torch.maximum
            return self.joined(join, [self.truth(part, below) for part in node.values])
        if isinstance(node, ast.IfExp):
            condition, yes, no = (self.node(n, below) for n in (node.test, node.body, node.orelse))
            return lambda v: _where(condition(v), yes(v), no(v))
        raise self.error(node, "is not allowed in a formula")

    def constant(self, node: ast.Constant) -> _Node:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            raise self.error(node, "is no number")
        try:
            number = torch.tensor(float(node.value), dtype=torch.float64)
        except OverflowError:
            raise self.error(node, "is too large") from None
        if not bool(torch.isfinite(number)):
            raise self.error(node, "is too large")
        return lambda v: number

    def name(self, node: ast.Name) -> _Node:
        key = node.id
        known = self.known
        if key in CONSTANTS and (known is None or key not in known):
            number = torch.tensor(CONSTANTS[key], dtype=torch.float64)
            return lambda v: number
        if known is not None and key not in known:
            raise self.error(node, f"is not known here{did_you_mean(key, (*known, *CONSTANTS))}")
        self.names[key] = None
        return lambda v: v[key]

    def unary(self, node: ast.UnaryOp, depth: int) -> _Node:
        if isinstance(node.op, ast.Not):
            truth = self.truth(node.operand, depth)
            return lambda v: 1.0 - truth(v)
        inner = self.node(node.operand, depth)
        if isinstance(node.op, ast.USub):
            return lambda v: -inner(v)
        if isinstance(node.op, ast.UAdd):
            return inner
        raise self.error(node, "is not allowed in a formula")

    def call(self, node: ast.Call, depth: int) -> _Node:
        if not isinstance(node.func, ast.Name):
            raise self.error(node, "is no function of formulas")
        name = node.func.id
        if name not in FUNCTIONS:
            raise self.error(node, f"calls no known function{did_you_mean(name, FUNCTIONS)}")
        count, function = FUNCTIONS[name]
        if node.keywords or len(node.args) != count:
            raise self.error(node, f"must have {count} argument{'s' if count > 1 else ''}")
        parts = [self.node(argument, depth) for argument in node.args]
        return lambda v: function(*(part(v) for part in parts))

    def compare(self, node: ast.Compare, depth: int) -> _Node:
        if any(type(op) not in _COMPARE for op in node.ops):
            raise self.error(node, "may compare by <, <=, > and >= only")
        sides = [self.node(n, depth) for n in (node.left, *node.comparators)]
        tests = [_COMPARE[type(op)] for op in node.ops]

        def holds(v: Values) -> Tensor:
            at = [side(v) for side in sides]
            out = tests[0](at[0], at[1])
            for test, a, b in zip(tests[1:], at[1:], at[2:], strict=False):
                out = out & test(a, b)
            return out.to(torch.float64)

        return holds

    def truth(self, node: ast.expr, depth: int) -> _Node:
        inner = self.node(node, depth)
        return lambda v: (inner(v) != 0.0).to(torch.float64)

    def joined(self, join: Callable[[Tensor, Tensor], Tensor], parts: list[_Node]) -> _Node:
        def joined(v: Values) -> Tensor:
            out = parts[0](v)
            for part in parts[1:]:
                out = join(out, part(v))
            return out

        return joined

    def error(self, node: ast.expr, why: str) -> ValueError:
        part = ast.get_source_segment(self.text, node) or type(node).__name__
        return ValueError(
            f"formula {self.text!r}, column {node.col_offset + 1}: {part!r} {why}; allowed are "
            f"numbers, names, + - * / **, comparisons, and {', '.join(FUNCTIONS)}"
        )
