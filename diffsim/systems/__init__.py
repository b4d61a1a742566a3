"""Real things that can be simulated and diagnosed: models, effects, and their studies."""

from diffsim.systems.libraries import library
from diffsim.systems.registry import SETUPS, setup_of
from diffsim.systems.saved import load_extended

__all__ = ["SETUPS", "library", "load_extended", "setup_of"]
