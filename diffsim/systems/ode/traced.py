"""Rates given by a Python function: run once with names in place of numbers, it leaves formulas.

So the integrator, its gradients and all causes are those of written formulas. The function may use
``+ - * / **``, numpy's and torch's elementary functions, ``where``, ``minimum`` and ``maximum``,
loops and other functions; it must not branch on values.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

from diffsim.core.expression import FUNCTIONS
from diffsim.data.study import Study

LONGEST = 300  # characters of a part of a formula: longer ones get a name
_OTHER_NAMES = {
    "minimum": "min", "fmin": "min", "maximum": "max", "fmax": "max", "absolute": "abs",
    "arcsin": "asin", "arccos": "acos", "arctan": "atan", "arctan2": "atan2", "arcsinh": "asinh",
    "clamp": "clip",
}  # fmt: skip
_OPERATORS = {
    "add": "+", "subtract": "-", "multiply": "*", "divide": "/", "true_divide": "/", "power": "**",
    "less": "<", "less_equal": "<=", "greater": ">", "greater_equal": ">=",
}  # fmt: skip


@dataclass
class _Trace:
    """Formulas of the parts that got a name."""

    named: dict[str, str] = field(default_factory=dict)

    def symbol(self, text: str) -> Symbol:
        """A formula, or the name of it where it is long."""
        if len(text) > LONGEST:
            name = f"traced_{len(self.named) + 1}"
            self.named[name] = text
            text = name
        return Symbol(text, self)


def _make_binary(operator: str, *, turned: bool = False) -> Callable[[Symbol, Any], Symbol]:
    def method(self: Symbol, other: Any) -> Symbol:
        a, b = self.text, _write_operand(other)
        a, b = (b, a) if turned else (a, b)
        return self.trace.symbol(f"({a} {operator} {b})")

    return method


@dataclass(frozen=True, eq=False)
class Symbol:
    """A number that is not known yet: operations on it are written down."""

    text: str
    trace: _Trace
    __array_priority__: ClassVar[float] = 1000.0

    __add__, __radd__ = _make_binary("+"), _make_binary("+", turned=True)
    __sub__, __rsub__ = _make_binary("-"), _make_binary("-", turned=True)
    __mul__, __rmul__ = _make_binary("*"), _make_binary("*", turned=True)
    __truediv__, __rtruediv__ = _make_binary("/"), _make_binary("/", turned=True)
    __pow__, __rpow__ = _make_binary("**"), _make_binary("**", turned=True)
    __lt__, __le__, __gt__, __ge__ = (_make_binary(o) for o in ("<", "<=", ">", ">="))

    def __neg__(self) -> Symbol:
        return self.trace.symbol(f"(-{self.text})")

    def __pos__(self) -> Symbol:
        return self

    def __abs__(self) -> Symbol:
        return self.called("abs", self)

    def __bool__(self) -> bool:
        raise TypeError(
            f"the function branches on the value of {self.text}; write where(condition, yes, no)"
        )

    def __float__(self) -> float:
        raise TypeError(
            f"the function makes a number of {self.text}; use numpy's functions, not those of math"
        )

    def called(self, name: str, *given: Any) -> Symbol:
        """A function of symbols and numbers."""
        if name in _OPERATORS and len(given) == 2:
            return self.trace.symbol(
                f"({_write_operand(given[0])} {_OPERATORS[name]} {_write_operand(given[1])})"
            )
        if name == "negative":
            return -self
        name = _OTHER_NAMES.get(name, name)
        if FUNCTIONS.get(name) != len(given):
            raise TypeError(f"{name} of {len(given)} is no function of formulas")
        return self.trace.symbol(f"{name}({', '.join(map(_write_operand, given))})")

    def __array_ufunc__(self, function: Any, method: str, *given: Any, **more: Any) -> Symbol:
        return self.called(function.__name__, *given)

    def __array_function__(self, function: Any, types: Any, given: Any, more: Any) -> Symbol:
        return self.called(function.__name__, *given)

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, given: Any, more: Any = None) -> Symbol:
        symbol = next(g for g in given if isinstance(g, Symbol))
        return symbol.called(function.__name__, *given)


def _write_operand(value: Any) -> str:
    if isinstance(value, Symbol):
        return value.text
    number = float(value)
    return repr(number) if number >= 0.0 else f"({number!r})"


def formulas_of(function: Callable[..., Any], where: str) -> tuple[dict[str, str], dict[str, str]]:
    """Formulas of what a function returns, and of the parts of it that got a name.

    Args:
        function: Takes quantities by the names of its arguments, returns rates by state.
        where: How messages call it.

    Raises:
        ValueError: it cannot be written as formulas, or returns no mapping.
    """
    trace = _Trace()
    names = list(inspect.signature(function).parameters)
    try:
        given = function(**{name: Symbol(name, trace) for name in names})
        if not isinstance(given, Mapping):
            raise TypeError(f"it must return rates by state, got {type(given).__name__}")
        rates = {str(k): _write_operand(v) for k, v in given.items()}
    except Exception as error:
        raise ValueError(f"{where}: {type(error).__name__}: {error}") from error
    return rates, trace.named


def with_function(study: Study, function: Callable[..., Any]) -> Study:
    """A study whose rates are those of a function instead of ``model.function``.

    Args:
        study: Study with ``model: {system: ode}``.
        function: Of states, inputs, parameters, definitions and ``t``, by the names of its
            arguments; returns the rate of every state, by name.

    Raises:
        ValueError: the function cannot be written as formulas.
    """
    model = dict(study.model or {})
    where = str(model.pop("function", getattr(function, "__name__", "function")))
    rates, named = formulas_of(function, f"model.function {where}")
    model |= {"rates": rates, "define": {**model.get("define", {}), **named}}
    return replace(study, model=model)
