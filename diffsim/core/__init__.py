"""Basis of all rooms: errors, argument checks, atomic files, rotations, compiled core."""

from typing import TYPE_CHECKING

from diffsim.core.errors import (
    ConvergenceError,
    ConvergenceWarning,
    DiffsimError,
    FactorizationError,
    InvertedElementError,
    MeshError,
)
from diffsim.core.interrupts import interruptible
from diffsim.core.lazy import offered

if TYPE_CHECKING:
    from diffsim.core.executors import open_executor
    from diffsim.core.progress import show_progress
    from diffsim.core.runs import run_each, run_kept

# what needs processes, or more than Python itself, is imported when it is asked for
_WHERE = {
    "open_executor": "executors",
    "run_each": "runs",
    "run_kept": "runs",
    "show_progress": "progress",
}
if not TYPE_CHECKING:  # to a type checker, any name would be one
    __getattr__, __dir__ = offered(__name__, {n: f"{__name__}.{m}" for n, m in _WHERE.items()})

__all__ = [
    "ConvergenceError",
    "ConvergenceWarning",
    "DiffsimError",
    "FactorizationError",
    "InvertedElementError",
    "MeshError",
    "interruptible",
    "open_executor",
    "run_each",
    "run_kept",
    "show_progress",
]
