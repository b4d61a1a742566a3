"""A diagnosed model, put to use: the best command for a task, and what mending a cause buys."""

from diffsim.sim_to_real.tracking import BestCommand, Tracking, TrackingTask, best_command
from diffsim.sim_to_real.worth import Worth, worth

__all__ = [
    "BestCommand",
    "Tracking",
    "TrackingTask",
    "Worth",
    "best_command",
    "worth",
]
