"""Basis of all rooms: errors, argument checks, atomic files, rotations, compiled core."""

from diffsim.core.errors import (
    ConvergenceError,
    ConvergenceWarning,
    DiffsimError,
    FactorizationError,
    InvertedElementError,
    MeshError,
)
from diffsim.core.interrupts import interruptible

__all__ = [
    "ConvergenceError",
    "ConvergenceWarning",
    "DiffsimError",
    "FactorizationError",
    "InvertedElementError",
    "MeshError",
    "interruptible",
]
