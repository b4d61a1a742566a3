"""Gymnasium environments on the simulators; importing this registers them.

``gymnasium.make("diffsim/CopterHover-v0")`` after ``import diffsim.envs``, or at once
``gymnasium.make("diffsim.envs:diffsim/CopterHover-v0")``. ``make_vector`` makes the native batch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from diffsim.core.lazy import offered
from diffsim.envs._gymnasium import gymnasium  # noqa: F401  asked for first
from diffsim.envs.env import TaskEnv
from diffsim.envs.registry import ENV_IDS, make_task, make_vector, register
from diffsim.envs.task import Entry, Randomization, Task, TaskState
from diffsim.envs.vector_env import TaskVectorEnv

if TYPE_CHECKING:  # only with stable-baselines3
    from diffsim.envs.sb3 import Sb3VecEnv

register()

if not TYPE_CHECKING:  # to a type checker, any name would be one
    __getattr__, _ = offered(__name__, {"Sb3VecEnv": f"{__name__}.sb3"})

__all__ = [
    "ENV_IDS",
    "Entry",
    "Randomization",
    "Sb3VecEnv",
    "Task",
    "TaskEnv",
    "TaskState",
    "TaskVectorEnv",
    "make_task",
    "make_vector",
]
