"""What every method is given: the task, the same first controller, the same fixed evaluation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from diffsim.control import MLPController
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.envs.registry import make_task
from diffsim.envs.rollout import Controller, rollout_task
from diffsim.envs.task import Task
from diffsim.envs.task_file import task_label
from diffsim.envs.vector_env import TaskVectorEnv
from diffsim.learn.checkpoint import controller_of

EVALUATION_SEED = 20_000  # of the starts that rate controllers; no run trains with it
WARM_UP_ENVS, WARM_UP_HOLD = 8, 5


@checked(kinds_only=True)
@dataclass(frozen=True)
class Setup:
    """One training run, whatever the method.

    Attributes:
        task: Such as "CopterHover", or a task file, "eel.yaml".
        task_options: Options of ``make_task``.
        seed: Seed of the first weights, the episodes, and everything drawn at random.
        steps: Budget of simulation steps.
        evaluate_every: Simulation steps between two ratings.
        evaluation_episodes: Whose mean reward is the rating; the same ones for every method.
        step_cost: What a step with its gradient costs, in steps without, by ``benchmarks.envs``.
        warm_up: Control steps of random commands from which observations are first normalized.
        output_gain: Gain of the first network's last layer, for every method. A small one makes a
            controller that hardly moves, which is where a copter hovers and a swimmer learns
            nothing.
        start: Folder of an earlier run, whose controller is the first one: of the same robot on a
            coarser mesh, or of an easier task; empty: a new network.
        balance_clock: Whether the first network listens to the task's clock, if it has one, as
            much as to all its other observations together.
    """

    task: str
    task_options: Mapping[str, Any] = field(default_factory=dict)
    seed: int = 0
    steps: int = 100_000
    evaluate_every: int = 10_000
    evaluation_episodes: int = 16
    step_cost: float = 2.5
    warm_up: int = 50
    output_gain: float = 0.01
    balance_clock: bool = False
    start: str = ""

    def require_new(self) -> Setup:
        """Itself, where no controller of an earlier run is to go on.

        Raises:
            ValueError: ``start`` names one, for a method without a network.
        """
        if self.start:
            raise ValueError(
                f"start must be empty for open-loop controllers, got {self.start!r}: they are no "
                "networks; leave it out"
            )
        return self

    def make_task(self) -> Task:
        """The task."""
        return make_task(self.task, **dict(self.task_options))

    @property
    def label(self) -> str:
        """What folders of results call the task."""
        return task_label(self.task)

    @checked
    def first_controller(self, task: Task) -> MLPController:
        """The controller that every method starts from; ``task`` is what ``make_task`` made."""
        if self.start:
            return controller_of(self.start, task)
        return first_controller(
            task,
            self.seed,
            self.warm_up,
            output_gain=self.output_gain,
            balance_clock=self.balance_clock,
        )


def first_controller(
    task: Task,
    seed: int,
    warm_up: int = 50,
    *,
    output_gain: float = 0.01,
    balance_clock: bool = False,
) -> MLPController:
    """The controller that all methods start from: seeded weights, observations normalized.

    The moments come from episodes under random commands, held for a few steps each; training
    methods go on to update them.

    Args:
        warm_up: Steps of each of eight episodes.
        output_gain: Gain of the last layer's weights.
        balance_clock: As of ``Setup``.
    """
    controller = MLPController(
        task.num_observations,
        task.num_actions,
        seed=seed,
        output_gain=output_gain,
        input_gains=clock_gains(task) if balance_clock else None,
    )
    assert controller.normalizer is not None  # asked for by default
    rng = np.random.default_rng([seed, 1])
    env = TaskVectorEnv(task, WARM_UP_ENVS)
    observations, _ = env.reset(seed=int(rng.integers(2**31)))
    for k in range(warm_up):
        if k % WARM_UP_HOLD == 0:
            commands = rng.uniform(-1.0, 1.0, (WARM_UP_ENVS, task.num_actions)).astype(np.float32)
        observations, *_ = env.step(commands)
        controller.normalizer.update(torch.from_numpy(observations).double())
    return controller


def clock_gains(task: Task) -> Tensor:
    """Factors on a first layer's weights, (num_observations,), so that a clock is heard.

    Normalized observations are alike in size and weights are alike in size: a layer's units hear
    the sum of n sensors sqrt(n / c) times as loud as that of c entries of a clock.
    """
    gains = torch.ones(task.num_observations, dtype=torch.float64)
    clocked = list(task.clock_inputs)
    if clocked:
        gains[clocked] = math.sqrt((task.num_observations - len(clocked)) / len(clocked))
    return gains


def evaluate(task: Task, controller: Controller, episodes: int) -> float:
    """Mean reward per step of whole episodes from fixed starts; nothing is earned after a failure.

    Args:
        task, controller: Who steers what; without noise.
        episodes: Number of episodes.

    Returns:
        NaN where the simulation broke down.
    """
    start = task.start(episodes, np.random.default_rng(EVALUATION_SEED))
    try:
        with torch.no_grad():
            rewards: Tensor = rollout_task(task, controller, start, task.max_steps).rewards
    except (ArithmeticError, RuntimeError, ValueError) as error:
        if not broke_down(error):
            raise
        return float("nan")
    return float(rewards.mean())


def broke_down(error: BaseException) -> bool:
    """Whether an exception says that a simulation left the finite numbers or did not converge.

    The simulators refuse to go on from NaN (ValueError "... must be finite ...") and raise
    ``DiffsimError`` where a solve fails.
    """
    return isinstance(error, DiffsimError | ArithmeticError) or "must be finite" in str(error)
