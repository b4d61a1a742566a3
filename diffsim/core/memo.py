"""What was computed before: by all that it depends on, and large arrays in temporary files."""

from __future__ import annotations

import ctypes
import math
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import field
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, Generic, TypeVar

import numpy as np

from diffsim.core.arrays import Array

_Value = TypeVar("_Value")
LARGE = 4 << 20  # bytes from which on an array is laid aside
WAITING = 256 * LARGE  # bytes of arrays in memory: with a quarter a long record wrote 9 GB
AT_HAND = 2  # arrays that were asked for last and stay in memory
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


class SpilledArray:
    """An array that waits in memory for its turn to go to a file, and comes back to the same bits.

    The newest stay in memory, up to ``WAITING`` bytes of all: most are dropped before their turn.
    One for which no file can be written stays, too.

    Args:
        array: It must not change any more.
    """

    def __init__(self, array: Array):
        self._shape, self._path = array.shape, ""
        self._key = object()  # names of files may come again
        if not (array.flags.c_contiguous or array.flags.f_contiguous):
            array = np.ascontiguousarray(array)  # products of another layout round otherwise
        self._kept: Array | None = array
        with _turn:  # the newest wait, those in front go to their files
            _waiting.append(weakref.ref(self))
            alive = [(ref, place) for ref in _waiting if (place := ref()) is not None]
            sizes = np.cumsum([8 * math.prod(place.shape) for _, place in alive][::-1])[::-1]
            first = int(np.sum(sizes > WAITING))
            _waiting[:] = [ref for ref, _ in alive[first:]]
            for _, place in alive[:first]:
                place.write()

    def write(self) -> None:
        """To its file, out of memory."""
        if (array := self._kept) is None:
            return
        try:
            with tempfile.NamedTemporaryFile(prefix="diffsim-", delete=False) as file:
                weakref.finalize(self, Path(file.name).unlink, missing_ok=True)
                np.save(file, array, allow_pickle=False)
        except OSError:  # the disk is full
            return
        self._path = file.name
        self._kept = None  # last: another thread may read it meanwhile
        _give_back()

    def array(self) -> Array:
        """The array as it was given; not to be written to."""
        if (kept := self._kept) is not None:
            return kept
        return _at_hand(self._key, lambda: np.load(self._path, allow_pickle=False))

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the array."""
        return self._shape

    def __len__(self) -> int:
        return self._shape[0]

    def __getitem__(self, rows: slice) -> Array:
        """Rows of the array, (stop - start, ...), without reading the others."""
        if (kept := self._kept) is not None:
            return kept[rows]
        mapped = np.load(self._path, mmap_mode="r", allow_pickle=False)
        return np.array(mapped[rows], order="K")

    def __reduce__(self) -> tuple[type[SpilledArray], tuple[Array]]:
        return type(self), (self.array(),)  # another process, or a copy, has a file of its own


def _give_back() -> None:
    """Hand free memory back to the system: between arrays of many sizes glibc keeps most of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def spill(array: Array) -> Array | SpilledArray:
    """A large array in a file, a small one as it is."""
    return array if array.nbytes < LARGE else SpilledArray(array)


class Aside:
    """An attribute of a class, or a field of a dataclass, whose arrays are laid aside."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._place = f"_{name}_aside"

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            raise AttributeError(self._place)  # to a dataclass: there is no default
        value = instance.__dict__[self._place]
        return value.array() if isinstance(value, SpilledArray) else value

    def __set__(self, instance: Any, value: Any) -> None:
        dense = isinstance(value, np.ndarray)
        instance.__dict__[self._place] = spill(value) if dense else value


_at_hand: Memo[Array] = Memo(AT_HAND)
_waiting: list[weakref.ref[SpilledArray]] = []
_turn = Lock()
