"""Values that are computed once for the tensors that they are made of."""

from __future__ import annotations

import operator
from typing import Generic, TypeVar

from torch import Tensor

T = TypeVar("T")


class ValueOfTensors(Generic[T]):
    """A value and the tensors that it was made of, as they were then."""

    def __init__(self, value: T, tensors: list[Tensor]):
        self.value = value
        self._tensors, self._versions = tensors, _versions(tensors)

    def is_of(self, tensors: list[Tensor]) -> bool:
        """Whether it was made of these, and none has changed since."""
        same = len(tensors) == len(self._tensors)
        same = same and all(map(operator.is_, tensors, self._tensors))
        return same and _versions(tensors) == self._versions


def _versions(tensors: list[Tensor]) -> list[int]:
    """How often each was changed in place; tensors of inference mode do not count it."""
    return [-1 if t.is_inference() else t._version for t in tensors]
