"""Public functions whose arguments are held against their signature before anything is computed.

:mod:`diffsim.core.check` has the checks; :func:`checked` says which arguments get which, from the
annotations that stand there anyway. A function that checks its arguments itself needs none of this.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial, wraps
from numbers import Real
from types import UnionType
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, overload

import numpy as np
import torch
from torch import Tensor

from diffsim.core.check import LARGEST, require, require_shape
from diffsim.core.numbers import values_of
from diffsim.core.values import as_array

_F = TypeVar("_F", bound=Callable[..., Any])
_K = TypeVar("_K", bound=type)
_Check = Callable[[Any], None]
Shape = Sequence[int | str]

_CONTAINERS: dict[str, tuple[Any, ...]] = {
    "tuple": (tuple, list),
    "Mapping": (Mapping,),
    "Sequence": (Sequence,),
    "Iterable": (Iterable,),
    "Callable": (Callable,),
}
_MISFIT = re.compile(
    r"size of tensor|sizes of tensors|shapes cannot be|size mismatch|out of bounds"
)
_ROWS: dict[Any, list[tuple[str, _Check | None]]] = {}
"""Checks by function: a graph must not find them in what a wrapper encloses."""
_NUMBERS = {"Number", "Value", "Vector"}
_PLAIN: dict[str, tuple[tuple[type, ...], str]] = {
    "float": ((float, int, np.number, Real), "a number"),
    "int": ((int, np.integer), "a whole number"),
    "str": ((str,), "text"),
    "bool": ((bool, int, np.bool_), "True or False"),
}
_BUILT_IN = {kind.__name__: kind for kind in (dict, list, set, frozenset, type, bytes, slice)}


@overload
def checked(function: _F, /) -> _F: ...


@overload
def checked(function: _F, /, *, kinds_only: bool, **shapes: Shape) -> _F: ...


@overload
def checked(*, kinds_only: bool = False, **shapes: Shape) -> Callable[[_F], _F]: ...


def checked(function: _F | None = None, /, *, kinds_only: bool = False, **shapes: Shape) -> Any:
    """Decorator of what is public: arguments are checked by their annotations.

    A ``Tensor`` must be dense, on the CPU, finite, at most ``LARGEST`` and of the shape that is
    given here; of floating numbers only float64. ``Number``, ``Value`` and ``Vector`` may be
    numbers, too. ``float``, ``int`` and ``str`` are what they say, and never NaN. Classes and
    containers must be that of the argument, or a base of it. Anything else passes, as does all
    where ``torch.compile`` traces.

    Args:
        function: Function, method, or a class, of which ``__init__`` is checked.
        kinds_only: Numbers may be any: of records of results, which may say that there is none.
        **shapes: Shapes of tensors by the argument's name, as ``require`` takes them.

    Returns:
        The same; it raises TypeError and ValueError that name the argument, or all tensors where
        it is their sizes that do not fit one another.
    """
    if function is None:
        return partial(checked, kinds_only=kinds_only, **shapes)
    if inspect.isclass(function):
        made: Any = function
        made.__init__ = checked(made.__init__, kinds_only=kinds_only, **shapes)
        return made

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        if torch.compiler.is_compiling():
            return function(*args, **named)
        row = _ROWS.get(function)
        if row is None:
            row = _ROWS[function] = _checks_of(function, shapes, kinds_only)
        for (_, check), value in zip(row, args, strict=False):
            if check is not None:
                check(value)
        for name, check in row if named else ():
            if check is not None and name in named:
                check(named[name])
        try:
            return function(*args, **named)
        except (RuntimeError, IndexError) as error:
            if not _MISFIT.search(str(error)):
                raise
            given = dict(zip((name for name, _ in row), args, strict=False)) | named
            sizes = {n: tuple(v.shape) for n, v in given.items() if isinstance(v, Tensor)}
            raise ValueError(
                f"sizes must fit one another, got {', '.join(f'{n} {z}' for n, z in sizes.items())}"
                f": {str(error).splitlines()[0]}"
            ) from error

    return call


def checked_methods(made: _K) -> _K:
    """Decorator of a class: its own public methods are ``checked(kinds_only=True)``."""
    for name, own in list(vars(made).items()):
        is_public = inspect.isfunction(own) and not name.startswith("_")
        if is_public and not getattr(own, "__isabstractmethod__", False):
            setattr(made, name, checked(own, kinds_only=True))
    return made


def _checks_of(
    function: Callable[..., Any], shapes: dict[str, Shape], kinds_only: bool
) -> list[tuple[str, _Check | None]]:
    """Names of arguments in their order, and what checks each."""
    named = getattr(inspect.unwrap(function), "__globals__", {})
    found: list[tuple[str, _Check | None]] = []
    for name, parameter in inspect.signature(function).parameters.items():
        text = str(parameter.annotation)
        words = [part for part in _alternatives(text) if part != "None"]
        is_one = parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        found_kinds = [_taker(word, named) for word in words] if is_one and text else []
        takes = [taker for taker in found_kinds if taker is not None]
        if not takes or len(takes) < len(
            words
        ):  # of an annotation that says less the body knows more
            found.append((name, None))
            continue
        optional = len(words) < len(_alternatives(text)) or parameter.default is None
        shape = shapes.get(name, ("...",))
        found.append((name, partial(_check, name, shape, optional, takes, kinds_only, set())))
    return found


def _alternatives(text: str) -> list[str]:
    """Parts of "A | B[C | D]": A and B[C | D]."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "[(") - (letter in "])")
        if letter == "|" and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


class _Taker(NamedTuple):
    """What an alternative of an annotation takes: classes, or what has attributes."""

    kinds: tuple[type, ...]
    what: str
    numbers: bool = False
    attributes: tuple[str, ...] = ()

    def fits(self, value: Any) -> bool:
        """Whether a value is of a class, or has what a protocol asks for."""
        has = self.attributes and all(
            hasattr(type(value), name) or hasattr(value, name) for name in self.attributes
        )
        return isinstance(value, self.kinds) or bool(has)


def _taker(word: str, named: Mapping[str, Any]) -> _Taker | None:
    head = word.partition("[")[0]
    if head in _NUMBERS:
        return _Taker((Tensor, float, int, list, tuple, np.ndarray, np.number), "numbers", True)
    if head in _PLAIN:
        return _Taker(*_PLAIN[head])
    if head in _CONTAINERS:
        arrays = () if head in ("Mapping", "Callable") else (Tensor, np.ndarray)
        return _Taker((*_CONTAINERS[head], *arrays), f"a {head}")
    thing: Any = {**_BUILT_IN, **named}.get(head.partition(".")[0])
    for part in head.split(".")[1:]:
        thing = getattr(thing, part, None)
    made_of = get_origin(thing)  # of an alias, such as Array
    if head == "Literal" or made_of is Literal:
        return _Taker((str, int, bool), "one of the words that are told")
    if made_of is Union or made_of is UnionType:
        thing, made_of = None, [get_origin(part) or part for part in get_args(thing)]
        if tuple in made_of:
            made_of.append(list)
    kinds = made_of if isinstance(made_of, list) else [made_of or thing]
    if not all(map(inspect.isclass, kinds)) or any(
        k is Any or hasattr(k, "__set__") for k in kinds
    ):
        return None
    if getattr(thing, "_is_protocol", False):
        above = [kind for kind in thing.__mro__ if getattr(kind, "_is_protocol", False)]
        names = {n for kind in above for n in (*vars(kind), *vars(kind).get("__annotations__", ()))}
        public = tuple(sorted(n for n in names if n[0] != "_" or n == "__call__"))
        return _Taker((), f"a {head}", attributes=public) if public else None
    if kinds == [np.ndarray]:
        return _Taker((np.ndarray,), "an array")
    words = [head] if thing is not None else [k.__name__ for k in kinds if k is not type(None)]
    said = (f"{'an' if word[0] in 'AEIOU' else 'a'} {word}" for word in words)
    return _Taker(tuple(kinds), " or ".join(said).replace("a Tensor", "a torch.Tensor"))


def _check(
    name: str,
    shape: Shape,
    optional: bool,
    takes: Sequence[_Taker],
    kinds_only: bool,
    fitting: set[type],
    value: Any,
) -> None:
    if value is None and optional:
        return
    if type(value) not in fitting:
        _require_kind(name, shape, takes, kinds_only, fitting, value)
    if kinds_only:
        return
    if isinstance(value, Tensor):
        whole = not value.is_floating_point() and not value.is_complex()
        require_shape(name, value, shape, value.dtype if whole else torch.float64)
        if not whole and not _largest(value) <= LARGEST:
            require(name, value, shape)  # says which entries are not finite
            raise ValueError(f"{name} must be at most {LARGEST:g}, where squares are numbers")
    elif any(t.numbers for t in takes):
        as_array(name, value)
    elif isinstance(value, (float, np.floating)) and math.isnan(value):
        raise ValueError(f"{name} must be a number, got nan")


def _largest(value: Tensor) -> float:
    """Largest size of an entry, NaN where one is."""
    if not value.numel():
        return 0.0
    low, high = torch.aminmax(values_of(value))  # one look at all, without a copy
    return max(-float(low), float(high))


def _require_kind(
    name: str,
    shape: Shape,
    takes: Sequence[_Taker],
    kinds_only: bool,
    fitting: set[type],
    value: Any,
) -> None:
    """Refuse a value of another kind; a class of which all fit is kept in ``fitting``."""
    number = getattr(value, "ndim", None) == 0 and any(float in t.kinds[:1] for t in takes)
    is_text = isinstance(value, str) and not any(str in t.kinds for t in takes)
    is_flag = isinstance(value, bool) and not any(bool in t.kinds for t in takes)
    fits = any(t.fits(value) for t in takes) and not is_text and not is_flag
    if fits and any(isinstance(value, t.kinds) for t in takes):
        fitting.add(type(value))  # asked a hundred thousand times
    is_row = not kinds_only and isinstance(value, (list, tuple))
    fits = fits or (is_row and any(np.ndarray in t.kinds for t in takes))
    if not (number or fits):
        if len(takes) == 1 and takes[0].kinds == (Tensor,):
            require(name, value, shape)
        wanted = " or ".join(dict.fromkeys(t.what for t in takes))
        raise TypeError(f"{name} must be {wanted}, got {type(value).__name__} {value!r:.40}")
