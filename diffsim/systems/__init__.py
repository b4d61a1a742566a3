"""Real things that can be simulated and diagnosed: models, effects, and their studies."""

from diffsim.systems.registry import load_extended, setup_of
from diffsim.systems.twin import Twin

__all__ = ["Twin", "load_extended", "setup_of"]
