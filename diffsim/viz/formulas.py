"""Formulas as readers see them: numbers put in, as text and as LaTeX."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from diffsim.core.expression import Name, Node, NumberNode, parse_expression
from diffsim.core.optional import optional

DIGITS = 4  # of numbers in a formula; files have all of them
_ARITHMETIC: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "pow": operator.pow,
    "neg": operator.neg,
}
_CALLED = {"abs": "Abs", "min": "Min", "max": "Max"}  # where sympy has another name


@dataclass(frozen=True)
class WrittenFormula:
    """A formula with its numbers put in.

    Attributes:
        text: As text.
        latex: As LaTeX.
    """

    text: str
    latex: str


def write_formula(
    formula: str, values: Mapping[str, float], words: Mapping[str, str]
) -> WrittenFormula | None:
    """A formula with numbers in place of some names, and other names in words.

    Args:
        formula: Such as ``"size*sin(k*u)"``.
        values: Numbers by name.
        words: What other names are called, such as "heat of current^2".

    Returns:
        None where sympy is not installed, or has no word for an operation.
    """
    try:
        sympy = optional("sympy", purpose="formulas as LaTeX")
    except ImportError:
        return None
    symbols = {name: sympy.Symbol(_in_brackets(text)) for name, text in words.items()}
    known = {**symbols, **{name: sympy.Float(v, DIGITS) for name, v in values.items()}}
    made = _build(sympy, parse_expression(formula).root, known)
    if made is None:
        return None
    upright = {symbols[name]: _upright(text) for name, text in words.items()}
    text = str(made)
    for name, called in _CALLED.items():
        text = text.replace(f"{called}(", f"{name}(")
    return WrittenFormula(text, sympy.latex(made, symbol_names=upright))


def _build(sympy: Any, node: Node, known: Mapping[str, Any]) -> Any | None:
    if isinstance(node, NumberNode):
        is_whole = node.value.is_integer()
        return sympy.Integer(int(node.value)) if is_whole else sympy.Float(node.value, DIGITS)
    if isinstance(node, Name):
        return known.get(node.name, sympy.Symbol(node.name))
    parts = [_build(sympy, part, known) for part in node.parts]
    name = _CALLED.get(node.operation, node.operation)
    join = _ARITHMETIC.get(node.operation) or getattr(sympy, name, None)
    return None if join is None or None in parts else join(*parts)


def _in_brackets(words: str) -> str:
    return words if words.isidentifier() else f"({words})"


def _upright(words: str) -> str:
    escaped = words.replace("_", r"\_").replace(" ", r"\ ")
    return rf"\mathrm{{{escaped}}}"
