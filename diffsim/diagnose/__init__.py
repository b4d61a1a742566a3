"""Diagnosis: what a simulation gets wrong, its cause, an extended model, and the gain."""

from diffsim.diagnose.effect import Effect
from diffsim.diagnose.libraries import library
from diffsim.diagnose.model import Numerics, Scene, SimModel

__all__ = ["Effect", "Numerics", "Scene", "SimModel", "library"]
