"""What short-horizon methods share: gradients through windows of a few steps, critics for what
comes after. They differ in how they explore (``Explorer``) and in the number of critics."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.core.checked import checked
from diffsim.envs.task import Task, TaskState, detached, where
from diffsim.learn.adam import Adam
from diffsim.learn.critics import Critics, td_lambda_targets
from diffsim.learn.explorer import Explorer
from diffsim.learn.gradient import NanGuard, cosine_rate
from diffsim.learn.run import Update, rng_state, set_rng_state
from diffsim.learn.setup import Setup, broke_down


@dataclass(frozen=True)
class WindowOptions:
    """Options of ``ShortHorizonLearner``.

    Attributes:
        batch: Episodes side by side; they persist between windows.
        window: Steps through which gradients flow.
        actor_rate, critic_rate: Learning rates of Adam; both fall to a tenth.
        discount: Weight of a reward per step that it comes later.
        trace: Lambda of the critic's targets.
        target_keep: Share of a target critic that stays at an update.
        critic_passes, critic_parts: Over the window's data, each in so many parts.
        warm_up: Windows at the start that train the critics alone: the actor follows their slope.
        exploration: First standard deviation of commands; learned.
        clip: Largest norm of a gradient.
        max_bad: The same as for ``GradientOptions``.
    """

    batch: int = 16
    window: int = 16
    actor_rate: float = 2e-3
    critic_rate: float = 2e-3
    discount: float = 0.99
    trace: float = 0.95
    target_keep: float = 0.4
    critic_passes: int = 8
    critic_parts: int = 4
    warm_up: int = 0
    exploration: float = 0.2
    clip: float = 1.0
    max_bad: int = 10


@dataclass
class WindowRecord:
    """What one window saw, without gradient: (steps, batch, ...)."""

    normalized: Tensor
    rewards: Tensor
    entropy: Tensor
    next_values: Tensor
    failed: Tensor
    ended: Tensor


class ShortHorizonLearner:
    """Actor, explorer and critics.

    Args:
        setup: Task and seed.
        options: Options of the method.
        explorer: Makes the one of a task.
        num_critics: Number of critics.
    """

    def __init__(
        self,
        setup: Setup,
        options: WindowOptions,
        explorer: Callable[[Task], Explorer],
        num_critics: int,
    ):
        self.options = o = options
        self.task: Task = setup.make_task()
        self.net = setup.first_controller(self.task)
        assert self.net.normalizer is not None  # of first_controller
        self.normalizer = self.net.normalizer
        self.explorer = explorer(self.task)
        self.actor_parameters = [*self.net.parameters(), *self.explorer.parameters()]
        self.critics = Critics(self.task.num_observations, o.discount, setup.seed, num_critics)
        self.actor_adam = Adam(self.actor_parameters, o.actor_rate, betas=(0.7, 0.95))
        self.critic_adam = Adam(self.critics.members.parameters(), o.critic_rate, betas=(0.7, 0.95))
        self.rng = np.random.default_rng([setup.seed, 3])
        self.windows = 0
        self.guard = NanGuard(o.max_bad)
        self.state = self.task.start(o.batch, self.rng)
        # so that episodes do not all end in the same window
        self.state["step"] = torch.from_numpy(self.rng.integers(0, self.task.max_steps, o.batch))

    def controller(self) -> nn.Module:
        """See ``Learner``."""
        return self.net

    @checked(kinds_only=True)
    def update(self, progress: float) -> Update:
        """One window, one step of the actor, a few passes of the critics."""
        o = self.options
        self.actor_adam.rate = cosine_rate(o.actor_rate, progress)
        self.critic_adam.rate = cosine_rate(o.critic_rate, progress)
        self.actor_adam.zero_grad()
        loss, norm, window = None, None, None
        before = self.state
        try:
            loss, window = self._window()
            loss.backward()
            norm = nn.utils.clip_grad_norm_(self.actor_parameters, o.clip)
        except (ArithmeticError, RuntimeError, ValueError) as error:
            if not broke_down(error):
                raise
        if self.guard.good(loss, norm):
            assert window is not None  # of good updates
            self._learn(window)
        else:
            self.state = self.task.start(len(before["step"]), self.rng)
        self.windows += 1
        steps = o.window * o.batch
        scalars = {
            "train/reward": math.nan if window is None else float(window.rewards.mean()),
            "train/entropy": math.nan if window is None else float(window.entropy.mean()),
            "train/gradient_norm": math.nan if norm is None else float(norm),
            "train/bad_updates": float(self.guard.total),
        }
        return Update(steps, steps, scalars | self.explorer.scalars())

    def _window(self) -> tuple[Tensor, WindowRecord]:
        """Roll all episodes on; minus the mean of their discounted rewards and values after."""
        o = self.options
        state, total = detached(self.state), torch.zeros(o.batch, dtype=torch.float64)
        weight = torch.ones(o.batch, dtype=torch.float64)  # discount since the window's start
        seen, record = [], []
        for k in range(o.window):
            observation = self.task.observe(state)
            seen.append(observation.detach())
            noise = self.rng.standard_normal((o.batch, self.task.num_actions))
            command, entropy = self.explorer.draw(self.net, observation, torch.from_numpy(noise))
            state, reward = self.task.step(state, command)
            total = total + weight * (reward + self.explorer.bonus(entropy))
            weight = weight * o.discount
            value, lowest = self.critics.values(self.normalizer(self.task.observe(state)))
            with torch.no_grad():
                failed = self.task.failed(state)
            ended = failed | (state["step"] >= self.task.max_steps)
            stop = ended if k < o.window - 1 else torch.ones_like(ended)
            # a time limit is not a death: what would have come still counts
            total = total + torch.where(stop & ~failed, weight * value, torch.zeros_like(value))
            record.append((reward.detach(), entropy.detach(), lowest, failed, ended))
            state, weight = self._restart(state, weight, ended)
        self.state = detached(state)
        rows = torch.stack(seen)
        with torch.no_grad():
            normalized = self.normalizer(rows)
        self.normalizer.update(rows)
        columns = [torch.stack(list(c)) for c in zip(*record, strict=True)]
        return -total.mean() / o.window, WindowRecord(normalized, *columns)

    def _restart(self, state: TaskState, weight: Tensor, ended: Tensor) -> tuple[TaskState, Tensor]:
        """Ended episodes start anew; their later rewards count in full."""
        if not bool(ended.any()):
            return state, weight
        fresh = self.task.start(len(ended), self.rng)
        return where(ended, fresh, state), torch.where(ended, torch.ones_like(weight), weight)

    def _learn(self, window: WindowRecord) -> None:
        o = self.options
        goals = self._goals(window)  # with the bonus that the window was played for
        if self.windows >= o.warm_up:
            self.actor_adam.step()
            self.explorer.adapt(window.entropy)
        self.critics.fit(
            self.critic_adam,
            window.normalized.flatten(0, 1),
            goals.flatten(),
            self.rng,
            passes=o.critic_passes,
            parts=o.critic_parts,
            clip=o.clip,
        )
        self.critics.follow(o.target_keep)

    def _goals(self, window: WindowRecord) -> Tensor:
        """Targets of the critics, (steps, batch)."""
        return td_lambda_targets(
            window.rewards + self.explorer.bonus(window.entropy),
            window.next_values,
            window.failed,
            window.ended,
            discount=self.options.discount,
            trace=self.options.trace,
        )

    def _modules(self) -> dict[str, Any]:
        return {
            "net": self.net,
            "explorer": self.explorer,
            "critics": self.critics,
            "actor_adam": self.actor_adam,
            "critic_adam": self.critic_adam,
        }

    def state_dict(self) -> dict[str, Any]:
        """See ``Learner``."""
        return {name: part.state_dict() for name, part in self._modules().items()} | {
            "rng": rng_state(self.rng),
            "windows": self.windows,
            "bad": [self.guard.total, self.guard.in_a_row],
            "state": dict(self.state),
        }

    @checked(kinds_only=True)
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See ``Learner``."""
        for name, part in self._modules().items():
            part.load_state_dict(state[name])
        set_rng_state(self.rng, state["rng"])
        self.windows = state["windows"]
        self.guard.total, self.guard.in_a_row = state["bad"]
        self.state = state["state"]
