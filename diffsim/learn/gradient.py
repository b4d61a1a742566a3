"""Adam through the simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.control import MLPController
from diffsim.core.checked import checked
from diffsim.envs.rollout import rollout_task
from diffsim.envs.task import Task, TaskState
from diffsim.learn.adam import Adam
from diffsim.learn.parallel import Batch, members_of, merged, own_members
from diffsim.learn.run import Update, rng_state, set_rng_state
from diffsim.learn.setup import Setup, broke_down


@checked
@dataclass(frozen=True)
class GradientOptions:
    """Options of ``GradientLearner``.

    Attributes:
        batch: Episodes per update.
        learning_rate: Rate of Adam at the start; falls along a half cosine over the budget.
        last_rate: What is left of the rate at the end of the budget, as a share; 1: no decay.
        horizon: Steps of an episode; 0: the task's.
        first_horizon: Steps of the first episodes; they grow to ``horizon`` over the budget, by as
            much with every step. Gradients of long episodes say little at first. 0: all alike.
        cut_every: Forget gradients of the state every so many steps; 0: never.
        clip: Largest norm of a gradient.
        beta1, beta2: Of Adam: how much of the running mean of gradients, and of their squares, is
            kept from update to update.
        max_bad: Updates in a row without a finite gradient, after which to give up.
    """

    batch: int = 8
    learning_rate: float = 3e-3
    last_rate: float = 0.1
    horizon: int = 0
    first_horizon: int = 0
    cut_every: int = 0
    clip: float = 1.0
    beta1: float = 0.9
    beta2: float = 0.999
    max_bad: int = 10


class BadGradients(RuntimeError):
    """Too many updates in a row had no finite gradient."""


class NanGuard:
    """Counts updates without a finite gradient and gives up after too many in a row.

    Args:
        max_bad: Largest number of them in a row.
    """

    def __init__(self, max_bad: int):
        self.max_bad, self.total, self.in_a_row = max_bad, 0, 0

    def good(self, loss: Tensor | None, norm: Tensor | None) -> bool:
        """Whether loss and norm of the gradient exist and are finite.

        Raises:
            BadGradients: ``max_bad`` times in a row they were not.
        """
        fine = loss is not None and norm is not None
        fine = fine and bool(torch.isfinite(loss.detach())) and bool(torch.isfinite(norm))  # type: ignore[union-attr, arg-type]
        self.in_a_row = 0 if fine else self.in_a_row + 1
        self.total += not fine
        if self.in_a_row >= self.max_bad:
            raise BadGradients(
                f"{self.in_a_row} updates in a row had no finite gradient; shorten the horizon "
                "with cut_every, lower the learning rate, or look at the task with gradient_quality"
            )
        return fine


def cosine_rate(first: float, progress: float, last: float = 0.1) -> float:
    """Learning rate falling from ``first`` to ``last`` times it along a half cosine."""
    return first * (last + (1.0 - last) * 0.5 * (1.0 + math.cos(math.pi * min(progress, 1.0))))


class GradientLearner:
    """Adam on the mean reward of whole episodes.

    Several processes may share the episodes of each batch (``learn.parallel``).

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    @checked
    def __init__(self, setup: Setup, options: GradientOptions | None = None):
        self.options = options or GradientOptions()
        self.task: Task = setup.make_task()
        self.net: MLPController = setup.first_controller(self.task)
        self.rng = np.random.default_rng([setup.seed, 2])
        o = self.options
        self.adam = Adam(self.net.parameters(), o.learning_rate, (o.beta1, o.beta2))
        self.guard = NanGuard(self.options.max_bad)

    def controller(self) -> nn.Module:
        """See ``Learner``."""
        return self.net

    @checked(kinds_only=True)
    def update(self, progress: float) -> Update:
        """One batch of episodes, one step of Adam; a batch without finite gradient is skipped."""
        o = self.options
        horizon = self._horizon(progress)
        mine = own_members(o.batch)
        start = members_of(self.task.start(o.batch, self.rng), mine)
        self.adam.zero_grad()
        self.adam.rate = cosine_rate(o.learning_rate, progress, o.last_rate)
        batch, norm = None, None
        try:
            batch = self._differentiate(start, horizon)
        except (ArithmeticError, RuntimeError, ValueError) as error:
            if not broke_down(error):
                raise
        batch = merged(batch, self.net.parameters(), (mine.stop - mine.start) / o.batch)
        if batch is not None:
            norm = nn.utils.clip_grad_norm_(self.net.parameters(), o.clip)
        if self.guard.good(None if batch is None else batch.reward, norm):
            self.adam.step()
            assert self.net.normalizer is not None and batch is not None  # of good updates
            self.net.normalizer.update(batch.seen)
        steps = horizon * o.batch
        scalars = {
            "train/reward": math.nan if batch is None else float(batch.reward),
            "train/gradient_norm": math.nan if norm is None else float(norm),
            "train/bad_updates": float(self.guard.total),
        }
        return Update(steps, steps, scalars | ({} if batch is None else batch.scalars))

    def _horizon(self, progress: float) -> int:
        """Steps of the episodes at a share of the budget."""
        last = self.options.horizon or self.task.max_steps
        first = self.options.first_horizon or last
        return round(first + (last - first) * min(progress, 1.0))

    def _differentiate(self, start: TaskState, horizon: int) -> Batch:
        """Leave the gradient of minus the mean reward in the network's parameters."""
        cut = self.options.cut_every or None
        episode = rollout_task(self.task, self.net, start, horizon, cut_every=cut)
        reward = episode.rewards.mean()
        (-reward).backward()
        return Batch(reward.detach(), episode.observations[episode.alive])

    def state_dict(self) -> dict[str, Any]:
        """See ``Learner``."""
        return {
            "net": self.net.state_dict(),
            "adam": self.adam.state_dict(),
            "rng": rng_state(self.rng),
            "bad": [self.guard.total, self.guard.in_a_row],
        }

    @checked(kinds_only=True)
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See ``Learner``."""
        self.net.load_state_dict(state["net"])
        self.adam.load_state_dict(state["adam"])
        set_rng_state(self.rng, state["rng"])
        self.guard.total, self.guard.in_a_row = state["bad"]
