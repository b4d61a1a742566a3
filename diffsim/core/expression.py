"""Formulas as text: parsed once, evaluated on tensors, never run as code.

A formula is one expression of numbers, names, ``+ - * / **``, comparisons, ``and or not``,
``a if condition else b`` and the functions of ``FUNCTIONS``. Anything else is refused when it is
parsed, with the column at which it stands.
"""

from __future__ import annotations

import ast
import math
import operator
import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import CodeType, FunctionType
from typing import Any, TypeAlias, cast

import torch
from torch import Tensor

from diffsim.core.check import did_you_mean
from diffsim.core.figures import counted

Values = Mapping[str, Tensor]

MAX_LENGTH = 2000  # characters: longer text is a program, not a formula
MAX_DEPTH = 40  # nested brackets; the parser itself recurses

_ONE_PARSES = threading.RLock()  # see syntax_tree

CONSTANTS = {"pi": math.pi, "e": math.e}


@dataclass(frozen=True)
class NumberNode:
    """A constant of a formula."""

    value: float


@dataclass(frozen=True)
class Name:
    """A quantity that a formula is made of."""

    name: str


@dataclass(frozen=True)
class Apply:
    """An operation of ``OPERATIONS`` on parts of a formula."""

    operation: str
    parts: tuple[Node, ...]


Node: TypeAlias = "NumberNode | Name | Apply"


def _less(a: Tensor, b: Tensor) -> Tensor:
    return (a < b).to(torch.float64)


def _less_equal(a: Tensor, b: Tensor) -> Tensor:
    return (a <= b).to(torch.float64)


def _where(condition: Tensor, yes: Tensor, no: Tensor) -> Tensor:
    return torch.where(condition != 0.0, yes, no)


OPERATIONS: dict[str, Callable[..., Tensor]] = {
    "add": torch.add,
    "sub": torch.sub,
    "mul": torch.mul,
    "div": torch.div,
    "pow": torch.pow,
    "neg": torch.neg,
    "less": _less,
    "less_equal": _less_equal,
    "min": torch.minimum,
    "max": torch.maximum,
    "where": _where,
    "abs": torch.abs,
    "sign": torch.sign,
    "sqrt": torch.sqrt,
    "exp": torch.exp,
    "log": torch.log,
    "sin": torch.sin,
    "cos": torch.cos,
    "tan": torch.tan,
    "asin": torch.asin,
    "acos": torch.acos,
    "atan": torch.atan,
    "sinh": torch.sinh,
    "cosh": torch.cosh,
    "tanh": torch.tanh,
    "asinh": torch.asinh,
    "atan2": torch.atan2,
    "hypot": torch.hypot,
}
"""What parts of formulas are joined by, on tensors."""

_WITH_TWO = ("min", "max", "atan2", "hypot")
_WITH_THREE = ("where", "clip")
_NO_FUNCTIONS = ("add", "sub", "mul", "div", "pow", "neg", "less", "less_equal")
FUNCTIONS = {
    name: 2 if name in _WITH_TWO else 3 if name in _WITH_THREE else 1
    for name in (*OPERATIONS, "clip")
    if name not in _NO_FUNCTIONS
}
"""Functions that a formula may call, and how many arguments each has."""

_BINARY: dict[type[ast.operator], str] = {
    ast.Add: "add",
    ast.Sub: "sub",
    ast.Mult: "mul",
    ast.Div: "div",
    ast.Pow: "pow",
}
# a > b is b < a
_COMPARE: dict[type[ast.cmpop], tuple[str, bool]] = {
    ast.Lt: ("less", False),
    ast.LtE: ("less_equal", False),
    ast.Gt: ("less", True),
    ast.GtE: ("less_equal", True),
}
_ZERO, _ONE = NumberNode(0.0), NumberNode(1.0)


@dataclass(frozen=True)
class Expression:
    """A parsed formula; call it with values by name."""

    text: str  # the formula as it was written
    names: tuple[str, ...]  # quantities that it needs, in order of appearance
    root: Node  # root of the syntax tree

    def __call__(self, values: Values) -> Tensor:
        """Value of the formula, float64, of the shape that its quantities broadcast to.

        Args:
            values: Quantities by name, float64 tensors that broadcast; more than needed is allowed.
        """
        return _evaluate(self.root, values)

    def on_floats(self, *names: str) -> Callable[..., float]:
        """The formula as a function of plain numbers, for callers that ask at every step.

        Args:
            *names: Quantities in the order in which the function takes them.
        """
        return _compile_floats(self.root, names)


def _evaluate(node: Node, values: Values) -> Tensor:
    if isinstance(node, NumberNode):
        return torch.tensor(node.value, dtype=torch.float64)
    if isinstance(node, Name):
        return values[node.name]
    return OPERATIONS[node.operation](*(_evaluate(part, values) for part in node.parts))


def _pow(base: float, exponent: float) -> float:
    try:
        out = base**exponent
    except (OverflowError, ZeroDivisionError):
        return math.inf
    return math.nan if isinstance(out, complex) else out


def _nan_outside(function: Callable[[float], float]) -> Callable[[float], float]:
    """A function that is not a number where Python's would raise, as a tensor's is."""

    def apply(value: float) -> float:
        try:
            return function(value)
        except (ValueError, OverflowError):
            return math.nan

    return apply


_ON_FLOATS: dict[str, Callable[..., float]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": lambda a, b: a / b if b else math.nan if a == 0.0 else math.copysign(math.inf, a),
    "pow": _pow,
    "neg": operator.neg,
    "less": lambda a, b: float(a < b),
    "less_equal": lambda a, b: float(a <= b),
    "min": min,
    "max": max,
    "where": lambda condition, yes, no: yes if condition != 0.0 else no,
    "abs": abs,
    "sign": lambda a: float((a > 0.0) - (a < 0.0)),
    "atan2": math.atan2,
    "hypot": math.hypot,
    **{
        name: _nan_outside(getattr(math, name))
        for name in (
            *("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan"),
            *("sinh", "cosh", "tanh", "asinh"),
        )
    },
}
"""The same on plain numbers."""


_BETWEEN: dict[str, type[ast.operator]] = {
    "add": ast.Add,
    "sub": ast.Sub,
    "mul": ast.Mult,
    "div": ast.Div,
    "pow": ast.Pow,
}
_COMPARING: dict[str, type[ast.cmpop]] = {"less": ast.Lt, "less_equal": ast.LtE}
_CALLED: dict[str, Any] = {
    **{f"safe_{name}": function for name, function in _ON_FLOATS.items()},
    **{name: getattr(math, name, function) for name, function in _ON_FLOATS.items()},
    "raised": (ValueError, OverflowError, ZeroDivisionError),
    "__builtins__": {},
}
"""All that a compiled formula can name beside its arguments."""


@lru_cache(maxsize=256)  # a law is asked anew for each size of it
def _compile_floats(node: Node, names: tuple[str, ...]) -> Callable[..., float]:
    """One function of plain numbers: a function for each node took many times as long to call.

    Made of checked nodes, never of a user's text, it can call nothing but functions of numbers.
    Where Python raises, the same is done once more by ``_ON_FLOATS``, which never do.
    """
    places = {name: f"value_{i}" for i, name in enumerate(names)}
    arguments = ast.arguments(
        posonlyargs=[], args=[ast.arg(place) for place in places.values()], kwonlyargs=[],
        kw_defaults=[], defaults=[],
    )  # fmt: skip
    fast, safe = (_python_of(node, places, is_safe) for is_safe in (False, True))
    caught = ast.ExceptHandler(ast.Name("raised", ast.Load()), None, [ast.Return(safe)])
    body: list[ast.stmt] = [ast.Try([ast.Return(fast)], [caught], [], [])]
    function = ast.FunctionDef("formula", arguments, body, [])
    code = compile(ast.fix_missing_locations(ast.Module([function], [])), "<formula>", "exec")
    (inner,) = (part for part in code.co_consts if isinstance(part, CodeType))
    return cast("Callable[..., float]", FunctionType(inner, _CALLED))


def _python_of(node: Node, places: Mapping[str, str], is_safe: bool) -> ast.expr:
    """A part of a formula as Python's syntax tree."""
    if isinstance(node, NumberNode):
        return ast.Constant(node.value)
    if isinstance(node, Name):
        return ast.Name(places[node.name], ast.Load())
    name = node.operation
    parts = [_python_of(part, places, is_safe) for part in node.parts]
    if is_safe:
        return ast.Call(ast.Name(f"safe_{name}", ast.Load()), parts, [])
    if name in _BETWEEN and not (name == "pow" and _may_be_complex(node)):
        return ast.BinOp(parts[0], _BETWEEN[name](), parts[1])
    if name == "neg":
        return ast.UnaryOp(ast.USub(), parts[0])
    if name in _COMPARING:
        holds = ast.Compare(parts[0], [_COMPARING[name]()], [parts[1]])
        return ast.IfExp(holds, ast.Constant(1.0), ast.Constant(0.0))
    return ast.Call(ast.Name(name, ast.Load()), parts, [])


def _may_be_complex(node: Apply) -> bool:
    exponent = node.parts[1]
    return not (isinstance(exponent, NumberNode) and exponent.value.is_integer())


def parse_expression(text: str | float, known: Iterable[str] | None = None) -> Expression:
    """Parse a formula.

    Args:
        text: Such as ``"k * x + c * tanh(v / 0.01)"``; a plain number is a constant formula.
        known: Names that the formula may use; None: any name.

    Returns:
        The formula.

    Raises:
        ValueError: not a formula, or an unknown name; the message shows the column and offers the
            closest names.
    """
    text = str(text).strip()
    if len(text) > MAX_LENGTH:
        raise ValueError(f"a formula may have {MAX_LENGTH} characters, got {len(text)}")
    try:
        tree = syntax_tree(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        at = f" at column {error.offset}" if isinstance(error, SyntaxError) else ""
        why = error.msg if isinstance(error, SyntaxError) else "nested too deeply"
        if re.search(r"(?<![<>=!])=(?!=)", text):
            why = f"{why}; write what is right of the = alone"
        raise ValueError(f"formula {text!r} cannot be read{at}: {why}") from None
    parser = _Parser(text, None if known is None else tuple(known))
    root = parser.node(tree, 0)
    return Expression(text, tuple(parser.names), root)


def syntax_tree(text: str) -> ast.expr:
    """Syntax tree of one Python expression; threads may ask at once, and each gets its own.

    Python 3.11 and 3.12 count the depth of a tree in one place for all threads: two that parse at
    once end in ``SystemError: AST constructor recursion depth mismatch`` (CPython issue 106905).

    Returns:
        Its outermost node.

    Raises:
        SyntaxError: not an expression.
        ValueError, RecursionError, MemoryError: what Python's parser cannot hold.
    """
    with _ONE_PARSES:
        return ast.parse(text, mode="eval").body


class _Parser:
    """One walk over a syntax tree; collects the names that it meets."""

    def __init__(self, text: str, known: tuple[str, ...] | None):
        self.text, self.known = text, known
        self.names: dict[str, None] = {}

    def node(self, node: ast.expr, depth: int) -> Node:
        """One part of the formula."""
        if depth > MAX_DEPTH:
            raise self.error(node, f"is nested more than {MAX_DEPTH} deep")
        below = depth + 1
        if isinstance(node, ast.Constant):
            return self.number(node)
        if isinstance(node, ast.Name):
            return self.name(node)
        if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            parts = (self.node(node.left, below), self.node(node.right, below))
            return Apply(_BINARY[type(node.op)], parts)
        if isinstance(node, ast.UnaryOp):
            return self.unary(node, below)
        if isinstance(node, ast.Call):
            return self.call(node, below)
        if isinstance(node, ast.Compare):
            return self.compare(node, below)
        if isinstance(node, ast.BoolOp):
            join = "min" if isinstance(node.op, ast.And) else "max"
            return _join_nodes(join, [self.truth(part, below) for part in node.values])
        if isinstance(node, ast.IfExp):
            chosen = (node.test, node.body, node.orelse)
            return Apply("where", tuple(self.node(part, below) for part in chosen))
        is_caret = isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor)
        hint = "; a power is written **" if is_caret else ""
        raise self.error(node, f"is not allowed in a formula{hint}")

    def number(self, node: ast.Constant) -> NumberNode:
        if isinstance(node.value, bool) or not isinstance(node.value, (int, float)):
            raise self.error(node, "is no number")
        try:
            value = float(node.value)
        except OverflowError:
            value = math.inf
        if not math.isfinite(value):
            raise self.error(node, "is too large")
        return NumberNode(value)

    def name(self, node: ast.Name) -> Node:
        key, known = node.id, self.known
        if key in CONSTANTS and (known is None or key not in known):
            return NumberNode(CONSTANTS[key])
        if known is not None and key not in known:
            raise self.error(node, f"is not known here{did_you_mean(key, (*known, *CONSTANTS))}")
        self.names[key] = None
        return Name(key)

    def unary(self, node: ast.UnaryOp, depth: int) -> Node:
        if isinstance(node.op, ast.Not):
            return Apply("sub", (_ONE, self.truth(node.operand, depth)))
        inner = self.node(node.operand, depth)
        if isinstance(node.op, ast.USub):
            return Apply("neg", (inner,))
        if isinstance(node.op, ast.UAdd):
            return inner
        raise self.error(node, "is not allowed in a formula")

    def call(self, node: ast.Call, depth: int) -> Node:
        if not isinstance(node.func, ast.Name):
            raise self.error(node, "is no function of formulas")
        name = node.func.id
        if name not in FUNCTIONS:
            raise self.error(node, f"calls no known function{did_you_mean(name, FUNCTIONS)}")
        count = FUNCTIONS[name]
        if node.keywords or len(node.args) != count:
            raise self.error(node, f"must have {counted(count, 'argument')}")
        parts = tuple(self.node(argument, depth) for argument in node.args)
        if name == "clip":
            return Apply("min", (Apply("max", parts[:2]), parts[2]))
        return Apply(name, parts)

    def compare(self, node: ast.Compare, depth: int) -> Node:
        if any(type(op) not in _COMPARE for op in node.ops):
            raise self.error(node, "may compare by <, <=, > and >= only")
        sides = [self.node(n, depth) for n in (node.left, *node.comparators)]
        tests = []
        for op, left, right in zip(node.ops, sides, sides[1:], strict=False):
            operation, is_swapped = _COMPARE[type(op)]
            tests.append(Apply(operation, (right, left) if is_swapped else (left, right)))
        return _join_nodes("min", tests)

    def truth(self, node: ast.expr, depth: int) -> Node:
        """1 where the part is not 0, else 0."""
        return Apply("where", (self.node(node, depth), _ONE, _ZERO))

    def error(self, node: ast.expr, why: str) -> ValueError:
        part = ast.get_source_segment(self.text, node) or type(node).__name__
        return ValueError(
            f"formula {self.text!r}, column {node.col_offset + 1}: {part!r} {why}; allowed are "
            f"numbers, names, + - * / **, comparisons, and {', '.join(FUNCTIONS)}"
        )


def _join_nodes(operation: str, parts: Sequence[Node]) -> Node:
    out = parts[0]
    for part in parts[1:]:
        out = Apply(operation, (out, part))
    return out
