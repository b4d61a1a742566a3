"""Formulas of columns: names that are no words of a formula stand in backquotes."""

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


def quoted_names(text: str) -> tuple[str, dict[str, str]]:
    """A formula with words in place of names in backquotes, and the name of each word."""
    names: dict[str, str] = {}

    def word(match: re.Match[str]) -> str:
        name = match.group(1)
        return names.setdefault(name, f"quoted_{len(names)}")

    plain = _QUOTED.sub(word, text)
    return plain, {word: name for name, word in names.items()}


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
            values[word] = torch.as_tensor(np.array(value_of(name), dtype=np.float64))
        else:
            written = [n if n.isidentifier() else f"`{n}`" for n in there]
            raise ValueError(
                f"formula {text!r}: no column or fact {name!r}{did_you_mean(name, written)}; "
                f"there are {', '.join(written)}, and {CLOCK}"
            )
    return np.array(np.broadcast_to(parsed(values).numpy(), clock.shape))
