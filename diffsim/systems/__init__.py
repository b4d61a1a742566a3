"""Real things that can be simulated and diagnosed: models, effects, and their studies."""

from diffsim.systems.registry import library, load_extended, setup_of

__all__ = ["library", "load_extended", "setup_of"]
