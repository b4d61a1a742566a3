"""What was computed before, by all that it depends on: one way to keep it for every layer."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import field
from functools import partial
from threading import Lock
from typing import Any, Generic, TypeVar

_Value = TypeVar("_Value")
MOST_KEPT = 4096  # more than any study asks for: a bound against growing for ever, no choice


class Memo(Generic[_Value]):
    """The last values of a pure function by its key: what is asked for again is not computed again.

    A value follows from its key (and from what owns the memo and does not change) to the last bit,
    so that no result depends on what was asked before; none is changed once it is kept. A copy, or
    what arrives in another process, begins empty. Threads may share it: at worst they compute the
    same value twice.

    Args:
        most: Number of values that are kept; the one that was asked for longest ago goes first.
    """

    def __init__(self, most: int = MOST_KEPT):
        self._most, self._lock = most, Lock()
        self._kept: OrderedDict[Hashable, _Value] = OrderedDict()

    def __call__(self, key: Hashable, compute: Callable[[], _Value]) -> _Value:
        """The value of a key, computed where it is not among the last ones."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        value = compute()  # which may ask the same memo
        with self._lock:
            self._kept[key] = value
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)
        return value

    def __reduce__(self) -> tuple[type[Memo[_Value]], tuple[int]]:
        return type(self), (self._most,)


def memo_field(most: int = MOST_KEPT) -> Any:
    """A field of a dataclass: a memo of its own for every instance, copies by ``replace`` included.

    Args:
        most: Number of values that are kept.
    """
    return field(default_factory=partial(Memo, most), init=False, repr=False, compare=False)
