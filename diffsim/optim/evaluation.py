"""One call of an objective: what it returned, what it cost, or how it failed."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked


class Sample(NamedTuple):
    """Result of an objective; a plain ``(value, gradient)`` will do where there are no notes.

    Attributes:
        value: Value to be minimized.
        gradient: Gradient of the value, (n,); None where only the value was asked for.
        notes: Whatever else should be kept with the evaluation. Plain numbers, strings and lists
            where a log is used, since they are written to it.
    """

    value: float
    gradient: Array | None = None
    notes: Mapping[str, Any] = {}


Objective = Callable[[Array], Sample | tuple[float, Array]]
ValueOnly = Callable[[Array], Sample | tuple[float, Array] | float]


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """An objective evaluated at one point.

    Attributes:
        x: Point at which the objective was evaluated, (n,).
        value: Value of the objective there; infinite where the evaluation failed.
        gradient: (n,); None where the evaluation failed or the objective gave none.
        failure: Message of the failure; empty where the evaluation succeeded.
        wall_s: Wall-clock time of the evaluation [s].
        cpu_s: Processor time of this process [s].
        notes: Further results of the objective; of plain types where the entry was read from a log.
    """

    x: Array
    value: float
    gradient: Array | None = None
    failure: str = ""
    wall_s: float = 0.0
    cpu_s: float = 0.0
    notes: Mapping[str, Any] = field(default_factory=dict)


@checked(kinds_only=True)
@dataclass(frozen=True, eq=False, kw_only=True)
class Progress:
    """State of a search after an evaluation, which callbacks receive.

    Attributes:
        count: Evaluations so far, this one included.
        evaluation: The latest evaluation.
        best: Least value so far; infinite while all evaluations have failed.
        replayed: The latest was read from the log, not computed.
    """

    count: int
    evaluation: Evaluation
    best: float
    replayed: bool


Callback = Callable[[Progress], object]
"""Called after every evaluation; a search ends where the answer is ``True``."""


class NotFiniteError(ArithmeticError):
    """An objective returned a value or a gradient that is not finite."""


def evaluate(objective: ValueOnly, x: Array) -> Evaluation:
    """Call an objective once, timed.

    Args:
        objective: Function of points (n,) that returns a value or a ``Sample``.
        x: The point, (n,); the objective gets a copy of its own.

    Raises:
        NotFiniteError: the value or the gradient is NaN or infinite.
        ValueError: the gradient has another shape than the point.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    returned = objective(x.copy())
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    sample = Sample(*returned) if isinstance(returned, tuple) else Sample(returned)
    value = float(sample.value)
    gradient = None
    if sample.gradient is not None:
        gradient = np.array(sample.gradient, dtype=np.float64)
        if gradient.shape != x.shape:
            raise ValueError(f"gradient must have shape {x.shape}, got {gradient.shape}")
    if not np.isfinite(value):
        raise NotFiniteError(f"value is not finite: {value}")
    if gradient is not None and not np.isfinite(gradient).all():
        raise NotFiniteError("gradient is not finite")
    return Evaluation(
        x=x.copy(), value=value, gradient=gradient, wall_s=wall, cpu_s=cpu, notes=sample.notes
    )


def failed(x: Array, error: Exception) -> Evaluation:
    """The record of an evaluation that raised ``error`` at the point x, (n,)."""
    return Evaluation(x=x.copy(), value=np.inf, failure=" ".join(str(error).split()) or repr(error))
