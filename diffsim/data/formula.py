"""Formulas of columns: names that are no words of a formula stand in backquotes.

``derivative(NAME)`` is the slope of a column in time, by central differences [1/s];
``unwrap(x, period)`` goes on over the ends of what a column counts, ``mod(x, n)`` is what is left
of whole n, ``floor(x)`` the next whole number below.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import torch

from diffsim.core.arrays import Array
from diffsim.core.check import did_you_mean
from diffsim.core.expression import parse_expression, syntax_tree
from diffsim.core.figures import counted
from diffsim.data.codes import unwrapped

CLOCK = "t"
_QUOTED = re.compile(r"`([^`]*)`")
_DERIVATIVE = re.compile(r"\bderivative\(\s*([A-Za-z_]\w*)\s*\)")
_SLOPE = "derivative_of_"  # before the word of a column: its slope
_PART = "part_of_record_"  # before the number of a call of OF_RECORDS: its samples
OF_RECORDS: dict[str, int] = {"unwrap": 2, "mod": 2, "floor": 1}
"""What formulas of records have beside those of models, and how many arguments each takes."""


def quoted_names(text: str) -> tuple[str, dict[str, str]]:
    """A formula with words in place of names in backquotes and of derivatives, and their names."""
    words: dict[str, str] = {}

    def word(match: re.Match[str]) -> str:
        name = match.group(1)
        return words.setdefault(name, f"quoted_{len(words)}")

    plain = _QUOTED.sub(word, text)
    names = {word: name for name, word in words.items()}

    def slope(match: re.Match[str]) -> str:
        of = match.group(1)
        names[_SLOPE + of] = names.get(of, of)
        return _SLOPE + of

    return _DERIVATIVE.sub(slope, plain), names


def names_in(text: str) -> tuple[str, ...]:
    """Columns and facts that a formula needs, its clock and NaN left out."""
    plain, quoted = quoted_names(text)
    rest, calls = _without_calls(plain)
    needed = dict.fromkeys(
        name
        for part in (rest, *(argument for _, _, given in calls for argument in given))
        for name in parse_expression(part).names
    )
    return tuple(
        quoted.get(n, n) for n in needed if n not in (CLOCK, "nan", *(word for word, _, _ in calls))
    )


def evaluate(
    text: str, clock: Array, value_of: Callable[[str], Array | float], known: Iterable[str]
) -> Array:
    """Samples of a formula.

    Args:
        text: Formula of columns, facts and ``t``.
        clock: Times of the run, (num_samples,) [s]: what ``t`` stands for.
        value_of: Samples (num_samples,) or the value of a column or fact by name.
        known: Names that there are, for the message.

    Returns:
        (num_samples,) float64.

    Raises:
        ValueError: a name that there is not.
    """
    plain, quoted = quoted_names(text)
    (rest, calls), there = _without_calls(plain), list(known)
    values: dict[str, torch.Tensor] = {}

    def value(part: str) -> Array:
        parsed = parse_expression(part)
        for word in parsed.names:
            if word in values:
                continue
            name = quoted.get(word, word)
            if word == CLOCK:
                values[word] = torch.tensor(clock, dtype=torch.float64)
            elif word == "nan":
                values[word] = torch.tensor(float("nan"), dtype=torch.float64)
            elif name in there:
                of = np.array(value_of(name), dtype=np.float64)
                is_slope = word != name and word.startswith(_SLOPE)
                values[word] = torch.as_tensor(_slope(of, clock) if is_slope else of)
            else:
                written = [n if n.isidentifier() else f"`{n}`" for n in there]
                raise ValueError(
                    f"formula {text!r}: no column or fact {name!r}{did_you_mean(name, written)}; "
                    f"there are {', '.join(written)}, and {CLOCK}"
                )
        return np.array(np.broadcast_to(parsed(values).numpy(), clock.shape))

    for word, function, given in calls:
        values[word] = torch.as_tensor(_of_record(function, [value(g) for g in given]))
    return value(rest)


def _of_record(function: str, given: list[Array]) -> Array:
    """Samples of a call of ``OF_RECORDS``."""
    if function == "floor":
        return np.floor(given[0])
    if function == "mod":
        return np.mod(*given)
    periods = np.unique(given[1])
    if len(periods) != 1 or not periods[0] > 0.0:
        raise ValueError("unwrap() needs one period above 0")
    return unwrapped(given[0], float(periods[0]))


def _without_calls(plain: str) -> tuple[str, list[tuple[str, str, list[str]]]]:
    """A formula with words in place of calls of ``OF_RECORDS``, and these, inner ones first: word,
    function, arguments."""
    calls: list[tuple[str, str, list[str]]] = []
    while (call := next(_inner_calls(plain), None)) is not None:
        assert isinstance(call.func, ast.Name)
        name = call.func.id
        if len(call.args) != OF_RECORDS[name] or call.keywords:
            count = OF_RECORDS[name]
            raise ValueError(f"{name}() must have {counted(count, 'argument')}")
        whole = ast.get_source_segment(plain, call)
        given = [ast.get_source_segment(plain, argument) for argument in call.args]
        assert whole is not None
        word = f"{_PART}{len(calls)}"
        calls.append((word, name, [f"({g})" for g in given]))
        plain = plain.replace(whole, word)
    return plain, calls


def _inner_calls(plain: str) -> Iterator[ast.Call]:
    """Calls of ``OF_RECORDS`` that have no such call inside; nothing of what is no formula."""
    if not any(f"{name}(" in plain.replace(" ", "") for name in OF_RECORDS):
        return
    try:
        tree = syntax_tree(plain.strip())
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return  # told where the formula is parsed
    for node in ast.walk(tree):
        if _is_own(node) and not any(_is_own(n) for n in ast.walk(node) if n is not node):
            assert isinstance(node, ast.Call)
            yield node


def _is_own(node: ast.AST) -> bool:
    is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return is_call and node.func.id in OF_RECORDS  # type: ignore[attr-defined]


def require_formula(text: str) -> str:
    """A formula of columns as it is, refused where it is none.

    Raises:
        ValueError: not a formula; the message shows the column.
    """
    rest, calls = _without_calls(quoted_names(text)[0])
    for part in (*(argument for _, _, given in calls for argument in given), rest):
        parse_expression(part)
    return text


def _slope(values: Array, clock: Array) -> Array:
    """Derivative in time by central differences; of a fact, or of a single row, there is none."""
    if values.ndim == 0 or len(values) < 2:
        raise ValueError("derivative() needs a column with two rows or more")
    return np.asarray(np.gradient(values, clock), dtype=np.float64)
