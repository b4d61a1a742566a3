"""The soft-body tasks that have a name: robot, length of episode, control period, reward."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from diffsim.core.check import require_options
from diffsim.envs.soft_jump import Jump
from diffsim.envs.soft_tasks import Advance, Reach
from diffsim.systems import robots
from diffsim.systems.robots import SoftRobot


def _make_robot(make: Callable[..., SoftRobot], options: Mapping[str, Any] | None) -> SoftRobot:
    """A robot from options; one that it does not have is refused with the closest names."""
    require_options(f"robot {make.__name__}", options or {}, make)
    return make(**(options or {}))


class StarfishSwim(Advance):
    """See ``diffsim.envs.registry.StarfishSwimEnv``."""

    name = "StarfishSwim"

    def __init__(
        self,
        *,
        num_steps: int = 200,
        start_speed: float = 0.1,
        robot: dict[str, Any] | None = None,
        **options: Any,
    ):
        body = _make_robot(robots.starfish, robot)
        super().__init__(body, num_steps, start_speed=start_speed, **options)


class SharkSwim(Advance):
    """See ``diffsim.envs.registry.SharkSwimEnv``."""

    name = "SharkSwim"

    def __init__(
        self,
        *,
        num_steps: int = 200,
        start_speed: float = 0.1,
        robot: dict[str, Any] | None = None,
        **options: Any,
    ):
        body = _make_robot(robots.shark, robot)
        super().__init__(body, num_steps, start_speed=start_speed, **options)


class QuadrupedWalk(Advance):
    """See ``diffsim.envs.registry.QuadrupedWalkEnv``."""

    name = "QuadrupedWalk"

    def __init__(
        self, *, num_steps: int = 100, robot: dict[str, Any] | None = None, **options: Any
    ):
        super().__init__(_make_robot(robots.quadruped, robot), num_steps, **options)


class CowWalk(Advance):
    """See ``diffsim.envs.registry.CowWalkEnv``."""

    name = "CowWalk"

    def __init__(
        self,
        *,
        num_steps: int = 60,
        substeps: int = 10,
        rise_weight: float = 0.3,
        robot: dict[str, Any] | None = None,
        **options: Any,
    ):
        super().__init__(
            _make_robot(robots.cow, robot),
            num_steps,
            substeps=substeps,
            rise_weight=rise_weight,
            **options,
        )


class TorusRoll(Advance):
    """See ``diffsim.envs.registry.TorusRollEnv``."""

    name = "TorusRoll"

    def __init__(
        self,
        *,
        num_steps: int = 100,
        substeps: int = 4,
        robot: dict[str, Any] | None = None,
        **options: Any,
    ):
        super().__init__(_make_robot(robots.torus, robot), num_steps, substeps=substeps, **options)


class TendonReach(Reach):
    """See ``diffsim.envs.registry.TendonReachEnv``."""

    name = "TendonReach"

    def __init__(
        self,
        *,
        num_steps: int = 100,
        goal_low: tuple[float, float, float] = (-0.12, -0.12, -0.06),
        goal_high: tuple[float, float, float] = (0.12, 0.12, 0.02),
        robot: dict[str, Any] | None = None,
        **options: Any,
    ):
        super().__init__(
            _make_robot(robots.tendon_arm, robot),
            num_steps,
            goal_low=goal_low,
            goal_high=goal_high,
            **options,
        )


class SoftJumper(Jump):
    """See ``diffsim.envs.registry.SoftJumperEnv``."""

    name = "SoftJumper"

    def __init__(
        self,
        *,
        num_steps: int = 300,
        substeps: int = 2,
        robot: dict[str, Any] | None = None,
        **options: Any,
    ):
        super().__init__(
            _make_robot(robots.soft_jumper, robot), num_steps, substeps=substeps, **options
        )
