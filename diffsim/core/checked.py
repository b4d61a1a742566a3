"""Public functions whose arguments are held against their signature before anything is computed.

:mod:`diffsim.core.check` has the checks; :func:`checked` says which arguments get which, from the
annotations that stand there anyway. A function that checks its arguments itself needs none of this.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Sequence
from functools import partial, wraps
from typing import Any, TypeVar

import torch
from torch import Tensor

from diffsim.core.check import require

_F = TypeVar("_F", bound=Callable[..., Any])
_Check = Callable[[Any], None]
Shape = Sequence[int | str]

_TENSORS = {"Tensor", "Number", "Value", "Vector"}
_PLAIN: dict[str, tuple[type, ...]] = {"float": (float, int), "int": (int,), "str": (str,)}


def checked(function: _F | None = None, /, **shapes: Shape) -> Any:
    """Decorator of a public function or method: its arguments are checked by their annotations.

    A ``Tensor`` must be dense, on the CPU, finite and of the shape that is given here; of floating
    numbers only float64. ``Number``, ``Value`` and ``Vector`` may be numbers, too. ``float``,
    ``int`` and ``str`` are what they say, and never NaN. A class must be that of the argument, or a
    base of it. Anything else passes, as does all where ``torch.compile`` traces.

    Args:
        function: What is called.
        **shapes: Shapes of tensors by the argument's name, as ``require`` takes them.

    Returns:
        The function; it raises TypeError and ValueError that name the argument.
    """
    if function is None:
        return partial(checked, **shapes)
    row: list[tuple[str, _Check | None]] = []

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        if not torch.compiler.is_compiling():
            if not row:
                row.extend(_checks_of(function, shapes))
            for (_, check), value in zip(row, args, strict=False):
                if check is not None:
                    check(value)
            for name, check in row if named else ():
                if check is not None and name in named:
                    check(named[name])
        return function(*args, **named)

    return call


def _checks_of(
    function: Callable[..., Any], shapes: dict[str, Shape]
) -> list[tuple[str, _Check | None]]:
    """Names of arguments in their order, and what checks each."""
    named = inspect.unwrap(function).__globals__
    found: list[tuple[str, _Check | None]] = []
    for parameter in inspect.signature(function).parameters.values():
        text = str(parameter.annotation)
        variable = parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        check = None if variable else _check_of(parameter.name, text, named, shapes)
        optional = check is not None and ("None" in text or parameter.default is None)
        found.append((parameter.name, partial(_unless_none, check) if optional else check))
    return found


def _check_of(
    name: str, text: str, named: dict[str, Any], shapes: dict[str, Shape]
) -> _Check | None:
    words = [part.strip() for part in text.split("|") if part.strip() != "None"]
    if any(re.search(r"[^\w.]", word) for word in words if not word.startswith("Sequence[float")):
        return None  # of containers and functions the body knows more
    if any(word in _TENSORS for word in words):
        return partial(_tensor, name, shapes.get(name, ("...",)), words == ["Tensor"])
    if all(word in _PLAIN for word in words):
        return partial(_plain, name, tuple(k for word in words for k in _PLAIN[word]), words)
    kinds = tuple(_look_up(word, named) for word in words)
    if words and all(inspect.isclass(kind) for kind in kinds):
        return partial(_object, name, kinds, words)
    return None


def _look_up(word: str, named: dict[str, Any]) -> Any:
    first, *rest = word.split(".")
    thing = named.get(first)
    for part in rest:
        thing = getattr(thing, part, None)
    is_protocol = getattr(thing, "_is_protocol", False)
    return None if is_protocol else thing


def _unless_none(check: _Check, value: Any) -> None:
    if value is not None:
        check(value)


def _tensor(name: str, shape: Shape, only: bool, value: Any) -> None:
    if isinstance(value, Tensor):
        whole = not value.is_floating_point() and not value.is_complex()
        require(name, value, shape, value.dtype if whole else torch.float64)
    elif only:
        require(name, value, shape)
    else:
        for number in value if isinstance(value, (list, tuple)) else (value,):
            _plain(name, (float, int), ["float"], number)


def _plain(name: str, kinds: tuple[type, ...], words: Sequence[str], value: Any) -> None:
    if getattr(value, "ndim", None) == 0:  # of NumPy, or a () tensor: the body may take it
        return
    if isinstance(value, bool) or not isinstance(value, kinds):
        what = {"float": "a number", "int": "a whole number", "str": "text"}
        wanted = " or ".join(what[word] for word in words)
        raise TypeError(f"{name} must be {wanted}, got {type(value).__name__} {value!r:.40}")
    if isinstance(value, float) and math.isnan(value):
        raise ValueError(f"{name} must be a number, got nan")


def _object(name: str, kinds: tuple[type, ...], words: Sequence[str], value: Any) -> None:
    if not isinstance(value, kinds):
        raise TypeError(f"{name} must be a {' or '.join(words)}, got {type(value).__name__}")
