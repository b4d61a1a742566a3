"""Basis of all rooms: errors, argument checks, atomic files, rotations, compiled core."""

from diffsim.core.errors import (
    ConvergenceError,
    ConvergenceWarning,
    DiffsimError,
    FactorizationError,
    InvertedElementError,
    MeshError,
)
from diffsim.core.executors import open_executor
from diffsim.core.interrupts import interruptible
from diffsim.core.runs import run_each, run_kept

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
]
