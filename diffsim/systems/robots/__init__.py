"""Soft robots ready to be simulated, steered and trained: swimmers, walkers, a jumper, an arm."""

from diffsim.systems.robots.arm import tendon_arm
from diffsim.systems.robots.jumper import soft_jumper
from diffsim.systems.robots.robot import SoftRobot
from diffsim.systems.robots.swimmers import shark, starfish
from diffsim.systems.robots.walkers import cow, quadruped, torus

__all__ = [
    "SoftRobot",
    "cow",
    "quadruped",
    "shark",
    "soft_jumper",
    "starfish",
    "tendon_arm",
    "torus",
]
