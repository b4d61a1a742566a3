"""Soft robots ready to be simulated, steered and trained: swimmers, walkers, an arm."""

from diffsim.robots.arm import tendon_arm
from diffsim.robots.robot import SoftRobot
from diffsim.robots.swimmers import shark, starfish
from diffsim.robots.walkers import cow, quadruped, torus

__all__ = ["SoftRobot", "cow", "quadruped", "shark", "starfish", "tendon_arm", "torus"]
