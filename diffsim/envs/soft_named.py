"""The soft-body tasks that have a name: robot, reward, and usual options such as the length.

Their data sheets are those of the environments in ``environments.yaml``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from diffsim.core.check import require_options
from diffsim.envs.soft_jump import Jump
from diffsim.envs.soft_tasks import Advance, Reach, SoftTask
from diffsim.systems import robots
from diffsim.systems.robots import SoftRobot


class NamedSoftTask(SoftTask):
    """A task whose robot is made of options.

    Args:
        robot: Arguments of the function that makes it; None: its defaults.
        **options: Options of the reward and of every soft task, in place of the usual ones.
    """

    make: ClassVar[Callable[..., SoftRobot]]  # function that makes the robot
    usual: ClassVar[Mapping[str, Any]]  # options where nothing else is asked for

    def __init__(self, *, robot: Mapping[str, Any] | None = None, **options: Any):
        given = dict(robot or {})
        require_options(f"robot {self.make.__name__}", given, self.make)
        super().__init__(self.make(**given), **{**self.usual, **options})


class StarfishSwim(NamedSoftTask, Advance):
    """See ``StarfishSwimEnv``."""

    name, make = "StarfishSwim", staticmethod(robots.starfish)
    usual = MappingProxyType({"num_steps": 200, "start_speed": 0.1})


class SharkSwim(NamedSoftTask, Advance):
    """See ``SharkSwimEnv``."""

    name, make = "SharkSwim", staticmethod(robots.shark)
    usual = StarfishSwim.usual


class QuadrupedWalk(NamedSoftTask, Advance):
    """See ``QuadrupedWalkEnv``."""

    name, make = "QuadrupedWalk", staticmethod(robots.quadruped)
    usual = MappingProxyType({"num_steps": 100})


class CowWalk(NamedSoftTask, Advance):
    """See ``CowWalkEnv``."""

    name, make = "CowWalk", staticmethod(robots.cow)
    usual = MappingProxyType({"num_steps": 60, "substeps": 10, "rise_weight": 0.3})


class TorusRoll(NamedSoftTask, Advance):
    """See ``TorusRollEnv``."""

    name, make = "TorusRoll", staticmethod(robots.torus)
    usual = MappingProxyType({"num_steps": 100, "substeps": 4})


class TendonReach(NamedSoftTask, Reach):
    """See ``TendonReachEnv``."""

    name, make = "TendonReach", staticmethod(robots.tendon_arm)
    usual = MappingProxyType(
        {"num_steps": 100, "goal_low": (-0.12, -0.12, -0.06), "goal_high": (0.12, 0.12, 0.02)}
    )


class SoftJumper(NamedSoftTask, Jump):
    """See ``SoftJumperEnv``."""

    name, make = "SoftJumper", staticmethod(robots.soft_jumper)
    usual = MappingProxyType({"num_steps": 300, "substeps": 2})
