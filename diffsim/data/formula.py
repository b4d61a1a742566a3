"""Formulas of columns: names that are no words of a formula stand in backquotes.

``derivative(NAME)`` is the slope of a column in time, by central differences [1/s].
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.check import did_you_mean
from diffsim.core.expression import parse_expression

Array = NDArray[np.float64]
CLOCK = "t"
_QUOTED = re.compile(r"`([^`]*)`")
_DERIVATIVE = re.compile(r"\bderivative\(\s*([A-Za-z_]\w*)\s*\)")
_SLOPE = "derivative_of_"  # before the word of a column: its slope


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
    needed = parse_expression(plain).names
    return tuple(quoted.get(n, n) for n in needed if n not in (CLOCK, "nan"))


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
    parsed, there = parse_expression(plain), list(known)
    values: dict[str, torch.Tensor] = {}
    for word in parsed.names:
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


def _slope(values: Array, clock: Array) -> Array:
    """Derivative in time by central differences; of a fact, or of a single row, there is none."""
    if values.ndim == 0 or len(values) < 2:
        raise ValueError("derivative() needs a column with two rows or more")
    return np.asarray(np.gradient(values, clock), dtype=np.float64)
