"""Which thresholds could change an answer: each is followed through it at half, one and double.

A threshold that an answer never reads cannot change it; neither can one of which every comparison
falls on the same side at all its values. So only what is left has to be answered again.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from numbers import Real
from typing import Any

import numpy as np
import torch

from labs.calibration.thresholds import FACTORS, listed, put, variant

Ways = Mapping[str, Any]


class Probe:
    """A number that knows what it would be, had thresholds other values.

    Arithmetic is done with every value. Where a comparison differs, or the number leaves for code
    that takes plain numbers alone, those thresholds are noted: they may change the answer.

    Args:
        plain: The number as it is; all that is computed goes on with this.
        ways: What it would be, by variant; those that are missing are equal to ``plain``.
        noted: Where variants are noted that may change the answer.
    """

    __slots__ = ("_noted", "_plain", "_ways")

    def __init__(self, plain: Any, ways: Ways, noted: set[str]) -> None:
        self._plain, self._ways, self._noted = plain, ways, noted

    def _left(self) -> Any:
        """The plain number, for code that cannot follow it."""
        self._noted.update(self._ways)
        return self._plain

    def __bool__(self) -> bool:
        return bool(_lift(bool, self))

    def __float__(self) -> float:
        return float(self._left())

    def __int__(self) -> int:
        return int(self._left())

    def __index__(self) -> int:
        return operator.index(self._left())

    def __round__(self, *digits: int) -> Any:
        return round(self._left(), *digits)

    def __hash__(self) -> int:
        return hash(self._left())

    def __format__(self, spec: str) -> str:
        return format(self._left(), spec)

    def __str__(self) -> str:
        return str(self._left())

    __repr__ = __str__

    def __len__(self) -> int:
        return len(self._left())

    def __getitem__(self, key: Any) -> Any:
        return _lift(operator.getitem, self, key)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._left(), name)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.array(self._left(), dtype=dtype)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if method == "__call__" and "out" not in options:
            return _lift(lambda *given: ufunc(*given, **options), *inputs)
        return getattr(ufunc, method)(*map(_plain_of, inputs), **options)

    @classmethod
    def __torch_function__(
        cls, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        named = {name: _plain_of(value) for name, value in (kwargs or {}).items()}
        return func(*map(_plain_of, args), **named)


Real.register(Probe)  # what asks for a number takes it


def _plain_of(value: Any) -> Any:
    """A value for code that cannot follow a probe; lists and tuples are looked into."""
    if isinstance(value, (list, tuple)) and any(isinstance(one, Probe) for one in value):
        return type(value)(map(_plain_of, value))
    return value._left() if isinstance(value, Probe) else value


def _lift(work: Callable[..., Any], *given: Any) -> Any:
    """What ``work`` gives, followed at all values of the probes among what it is given."""
    probes = [one for one in given if isinstance(one, Probe)]
    plain = work(*(one._plain if isinstance(one, Probe) else one for one in given))
    noted = probes[0]._noted
    ways = {}
    for name in {name for probe in probes for name in probe._ways}:
        own = (one._ways.get(name, one._plain) if isinstance(one, Probe) else one for one in given)
        try:
            value = work(*own)
        except (ArithmeticError, TypeError, ValueError, IndexError):
            noted.add(name)  # nobody knows what would follow
            continue
        if not _is_same(plain, value):
            ways[name] = value
    if ways and _decides(plain):
        noted.update(ways)
        return plain
    return Probe(plain, ways, noted) if ways else plain


def _decides(value: Any) -> bool:
    """Whether it is true or false, or an array of these."""
    if isinstance(value, (bool, np.bool_)):
        return True
    return isinstance(value, (np.ndarray, torch.Tensor)) and value.dtype in (bool, torch.bool)


def _is_same(a: Any, b: Any) -> bool:
    if isinstance(a, torch.Tensor) or isinstance(b, torch.Tensor):
        return bool(torch.equal(torch.as_tensor(a), torch.as_tensor(b)))
    return bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))


def _both_sides(work: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    """The methods of an operator, with the probe to its left and to its right."""
    return (
        lambda self, other: _lift(work, self, other),
        lambda self, other: _lift(work, other, self),
    )


def _of_one(work: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda self: _lift(work, self)


for _name in ("lt", "le", "gt", "ge", "eq", "ne"):
    setattr(Probe, f"__{_name}__", _both_sides(getattr(operator, _name))[0])
for _name in ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow"):
    _left_side, _right_side = _both_sides(getattr(operator, _name))
    setattr(Probe, f"__{_name}__", _left_side)
    setattr(Probe, f"__r{_name}__", _right_side)
for _name in ("neg", "pos", "abs"):
    setattr(Probe, f"__{_name}__", _of_one(getattr(operator, _name)))


@contextmanager
def probed() -> Iterator[set[str]]:
    """Every listed threshold as a probe; the variants that may change what is computed within."""
    noted: set[str] = set()
    with ExitStack() as stack:
        for threshold in listed():
            ways = {variant(threshold, factor): threshold.times(factor) for factor in FACTORS}
            changed = {name: value for name, value in ways.items() if value != threshold.value}
            stack.enter_context(put(threshold, Probe(threshold.value, changed, noted)))
        yield noted
