"""Checks of whole numbers and of options by name, in the style of ``core.check``."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from diffsim.core.check import require_choice, require_number

_BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)

MAX_COUNT = 2**31 - 1


def require_count(name: str, value: Any, *, at_least: int = 0, hint: str = "") -> int:
    """Check that a number is whole and not too small; 3.0 and NumPy's 3 are taken as 3.

    Raises:
        TypeError: not a number.
        ValueError: not whole, too small, or not finite.
    """
    plain = value.item() if getattr(value, "ndim", None) == 0 else value
    if isinstance(plain, bool) or not isinstance(plain, (int, float)):
        raise TypeError(f"{name} must be a number, got {type(plain).__name__}")
    if not at_least <= plain <= MAX_COUNT or plain != int(plain):  # NaN is nowhere
        upper = "" if plain < MAX_COUNT else f" and at most {MAX_COUNT}"
        more = f"; {hint}" if hint else ""
        raise ValueError(f"{name} must be a whole number >= {at_least}{upper}, got {plain!r}{more}")
    return int(plain)


MAX_THREADS = 1024
"""More than any processor runs; a larger number is a mistake, or the size of something else."""


def require_threads(num_threads: int) -> int:
    """Check the number of threads of a call: a whole number from 1 to ``MAX_THREADS``."""
    count = require_count("num_threads", num_threads, at_least=1)
    if count > MAX_THREADS:
        raise ValueError(
            f"num_threads must lie in [1, {MAX_THREADS}], got {count}; more than the processor has "
            "cores does not pay"
        )
    return count


def require_numbers(
    name: str, values: Sequence[float], count: int | Sequence[int], **limits: Any
) -> tuple[float, ...]:
    """Check so many finite numbers within limits: a list, a tuple, an array or a tensor.

    Args:
        name: The argument's name, for the message.
        values: Numbers.
        count: How many there must be, or which counts will do.
        **limits: As of ``require_number``.

    Raises:
        TypeError: no numbers.
        ValueError: another count, or a number out of its limits.
    """
    counts = (count,) if isinstance(count, int) else tuple(count)
    wanted = " or ".join(map(str, counts))
    if isinstance(values, (str, bytes, Mapping)):
        raise TypeError(f"{name} must be {wanted} numbers, got {values!r}")
    try:
        given = list(values)
    except TypeError:
        raise TypeError(f"{name} must be {wanted} numbers, got {values!r}") from None
    if len(given) not in counts:
        raise ValueError(f"{name} must be {wanted} numbers, got {len(given)}: {given!r}")
    return tuple(require_number(f"{name}[{k}]", v, **limits) for k, v in enumerate(given))


def require_counts(name: str, values: Sequence[int], count: int | Sequence[int]) -> tuple[int, ...]:
    """``require_numbers`` of whole numbers from 1 on."""
    numbers = require_numbers(name, values, count)
    return tuple(require_count(f"{name}[{k}]", n, at_least=1) for k, n in enumerate(numbers))


def require_options(
    what: str, options: Iterable[str], *takers: Callable[..., Any], known: Iterable[str] = ()
) -> None:
    """Check that some function takes each option; the message offers the closest names.

    Args:
        what: What the options are of, for the message, such as "CopterHover".
        options: Names of keyword arguments.
        takers: Functions or classes that take them.
        known: Further names that are allowed.

    Raises:
        ValueError: no taker has such an option.
    """
    names = [*known, *(name for taker in takers for name in option_names(taker))]
    for name in options:
        require_choice(f"option of {what}", name, dict.fromkeys(names))


def option_names(taker: Callable[..., Any]) -> tuple[str, ...]:
    """Names of arguments; of a class with ``**options`` those of the classes that it is from, too.

    Args:
        taker: A function or a class.
    """
    classes = taker.__mro__ if isinstance(taker, type) else ()
    made = [vars(kind)["__init__"] for kind in classes if "__init__" in vars(kind)]
    names: dict[str, None] = {}
    for function in made or [taker]:
        given: Mapping[str, inspect.Parameter] = inspect.signature(function).parameters
        names |= {p.name: None for p in given.values() if p.name != "self" and p.kind in _BY_NAME}
        if not any(p.kind is p.VAR_KEYWORD for p in given.values()):
            break
    return tuple(names)
