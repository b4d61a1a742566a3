"""Large arrays that are rarely looked at: they lie in temporary files, not in memory."""

from __future__ import annotations

import ctypes
import tempfile
import weakref
from collections import OrderedDict
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
LARGE = 1 << 20  # bytes from which on an array is laid aside
AT_HAND = 64 << 20  # bytes of what was asked for last, which stay in memory


class LaidAside:
    """An array that is read from a file each time it is asked for, to the same bits.

    Small ones stay in memory, as do large ones where no file can be written.

    Args:
        array: It must not change any more.
    """

    def __init__(self, array: Array):
        self._kept: Array | None = array
        self._shape, self._path = array.shape, ""
        if array.nbytes < LARGE:
            return
        if not (array.flags.c_contiguous or array.flags.f_contiguous):
            array = np.ascontiguousarray(array)  # products of another layout round otherwise
        self._kept = array
        try:
            with tempfile.NamedTemporaryFile(dir=_folder(), suffix=".npy", delete=False) as file:
                weakref.finalize(self, Path(file.name).unlink, missing_ok=True)
                np.save(file, array, allow_pickle=False)
        except OSError:  # the disk is full
            return
        self._kept, self._path = None, file.name
        _at_hand.put(self._path, array)
        _give_back()

    def array(self) -> Array:
        """The array as it was given; not to be written to."""
        if self._kept is not None:
            return self._kept
        found = _at_hand.get(self._path)
        if found is None:
            found = np.load(self._path, allow_pickle=False)
            _at_hand.put(self._path, found)
        return found

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the array."""
        return self._shape

    def __len__(self) -> int:
        return self._shape[0]

    def __getitem__(self, rows: slice) -> Array:
        """Rows of the array, (stop - start, ...), without reading the others."""
        if self._kept is not None:
            return self._kept[rows]
        mapped = np.load(self._path, mmap_mode="r", allow_pickle=False)
        return np.array(mapped[rows], order="K")

    def __reduce__(self) -> tuple[type[LaidAside], tuple[Array]]:
        return type(self), (self.array(),)  # another process, or a copy, has a file of its own


def _give_back() -> None:
    """Hand free memory back to the system: between arrays of many sizes glibc keeps most of it."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


class Aside:
    """An attribute of a class, or a field of a dataclass, whose arrays are laid aside."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._place = f"_{name}_aside"

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        if instance is None:
            raise AttributeError(self._place)  # to a dataclass: there is no default
        value = instance.__dict__[self._place]
        return value.array() if isinstance(value, LaidAside) else value

    def __set__(self, instance: Any, value: Any) -> None:
        dense = isinstance(value, np.ndarray)
        instance.__dict__[self._place] = LaidAside(value) if dense else value


class _AtHand:
    """The arrays that were asked for last, as many as ``AT_HAND`` holds."""

    def __init__(self) -> None:
        self._arrays: OrderedDict[str, Array] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def get(self, path: str) -> Array | None:
        with self._lock:
            if path in self._arrays:
                self._arrays.move_to_end(path)
            return self._arrays.get(path)

    def put(self, path: str, array: Array) -> None:
        with self._lock:
            self._bytes += array.nbytes - getattr(self._arrays.get(path), "nbytes", 0)
            self._arrays[path] = array
            self._arrays.move_to_end(path)
            while self._bytes > AT_HAND:
                self._bytes -= self._arrays.popitem(last=False)[1].nbytes


_at_hand = _AtHand()


@lru_cache(maxsize=1)
def _folder() -> str:
    folder = tempfile.TemporaryDirectory(prefix="diffsim-")
    _folders.append(folder)  # removed with this process
    return folder.name


_folders: list[tempfile.TemporaryDirectory[str]] = []
