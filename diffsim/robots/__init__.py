"""Soft robots ready to be simulated, steered and trained: swimmers, walkers, an arm."""

from diffsim.robots.robot import SoftRobot
from diffsim.robots.swimmers import shark, starfish

__all__ = ["SoftRobot", "shark", "starfish"]
