"""The soft-body tasks that have a name: robot, length of episode and scale of reward."""

from __future__ import annotations

from typing import Any

from diffsim import robots
from diffsim.envs.soft_tasks import Advance


class StarfishSwim(Advance):
    """See ``StarfishSwimEnv``."""

    name = "StarfishSwim"

    def __init__(
        self, *, num_steps: int = 200, robot: dict[str, Any] | None = None, **options: Any
    ):
        super().__init__(robots.starfish(**(robot or {})), num_steps, **options)


class SharkSwim(Advance):
    """See ``SharkSwimEnv``."""

    name = "SharkSwim"

    def __init__(
        self, *, num_steps: int = 200, robot: dict[str, Any] | None = None, **options: Any
    ):
        super().__init__(robots.shark(**(robot or {})), num_steps, **options)
