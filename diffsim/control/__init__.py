"""Controllers: open loop with few parameters, and networks of what is sensed."""

from diffsim.control.closed_loop import MLPController, Normalizer
from diffsim.control.open_loop import Knots, OpenLoop, Sinusoid

__all__ = ["Knots", "MLPController", "Normalizer", "OpenLoop", "Sinusoid"]
