"""Shapes as numbers: ops take no objects, so a search that no graph can hold names its shape."""

from __future__ import annotations

import itertools
import weakref
from typing import TypeVar

_numbers = itertools.count(1)
_shapes: weakref.WeakValueDictionary[int, object] = weakref.WeakValueDictionary()
_Kind = TypeVar("_Kind")


def new_handle(shape: object) -> int:
    """A number by which :func:`shape_of` finds a shape as long as it lives."""
    handle = next(_numbers)
    _shapes[handle] = shape
    return handle


def shape_of(handle: int, kind: type[_Kind]) -> _Kind:
    """The shape of a handle.

    Raises:
        RuntimeError: that shape is gone, or of another kind.
    """
    shape = _shapes.get(handle)
    if not isinstance(shape, kind):
        raise RuntimeError(
            f"no {kind.__name__} has handle {handle}; keep obstacles alive as long as graphs that "
            "were compiled with them"
        )
    return shape
