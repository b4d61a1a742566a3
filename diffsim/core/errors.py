"""Users' mistakes are ValueError or TypeError; what numerics could not do is DiffsimError."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any


class DiffsimError(RuntimeError):
    """Base of everything that the numerics could not do; carries its data, from workers too."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _made_again, (type(self), self.args, self.__dict__)


def _made_again(kind: type[DiffsimError], args: tuple[Any, ...], data: dict[str, Any]) -> Any:
    """An error that was pickled; constructors with keywords would not take ``args`` alone."""
    error = kind.__new__(kind, *args)
    error.__dict__.update(data)
    return error


class Mistakes(ValueError):
    """Mistakes of a user that were found together, told a line each.

    Args:
        lines: What is wrong and where, a line for each mistake.
        most: Lines that are told; how many more there are is told after them. None: all.

    Attributes:
        count: Number of mistakes, those that are not told included.
    """

    def __init__(self, lines: Sequence[str], most: int | None = None):
        told, self.count = list(lines[:most]), len(lines)
        more = [f"... and {self.count - len(told)} more"] if len(told) < self.count else []
        super().__init__("\n".join([*told, *more]))


class ConvergenceError(DiffsimError):
    """An iterative solve stopped above its tolerance.

    Attributes:
        residual_norm: Norm of the last residual, in the unit of the solve (N for a step).
        tolerance: The norm that was asked for, same unit.
        num_iters: Number of iterations done.
    """

    def __init__(self, message: str, *, residual_norm: float, tolerance: float, num_iters: int):
        super().__init__(message)
        self.residual_norm = residual_norm
        self.tolerance = tolerance
        self.num_iters = num_iters


class IntegrationError(DiffsimError):
    """States of an equation are no numbers from some time on.

    Attributes:
        item: Index in the batch.
        time: The first sample that is none [s].
    """

    def __init__(self, message: str, *, item: int, time: float):
        super().__init__(message)
        self.item = item
        self.time = time


class ConvergenceWarning(UserWarning):
    """An iterative solve stopped above its tolerance, where the caller chose to go on."""


class ContactWarning(UserWarning):
    """Contacts whose law has no answer; the warning says what was taken instead."""


class FactorizationError(DiffsimError):
    """A matrix that should be symmetric positive definite is not.

    Attributes:
        pivot: Index of the unknown whose pivot failed.
        value: Pivot that is not positive.
    """

    def __init__(self, message: str, *, pivot: int, value: float):
        super().__init__(message)
        self.pivot = pivot
        self.value = value


class InvertedElementError(DiffsimError):
    """Elements are turned inside out where the material's energy is infinite.

    Attributes:
        num_inverted: Number of inverted elements.
    """

    def __init__(self, message: str, *, num_inverted: int):
        super().__init__(message)
        self.num_inverted = num_inverted


class MeshError(ValueError):
    """A mesh that cannot be simulated; the message names the elements or nodes.

    Attributes:
        indices: The offending elements, nodes or edges (first ones where there are many).
    """

    def __init__(self, message: str, indices: tuple[int, ...] = ()):
        super().__init__(message)
        self.indices = indices
