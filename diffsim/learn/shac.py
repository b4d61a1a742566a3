"""Short-horizon actor-critic (Xu et al., "Accelerated policy learning with parallel differentiable
simulation", ICLR 2022): gradients through short windows, a critic for what comes after."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.control import MLPController
from diffsim.envs.task import Task, TaskState, detached, where
from diffsim.learn.gradient import NanGuard, cosine_rate, set_rate
from diffsim.learn.run import Update, rng_state, set_rng_state
from diffsim.learn.setup import Setup, broke_down, first_controller


@dataclass(frozen=True)
class ShacOptions:
    """Of ``ShacLearner``.

    Attributes:
        batch: Episodes side by side; they persist between windows.
        window: Steps through which gradients flow.
        actor_rate, critic_rate: Learning rates of Adam; both fall to a tenth.
        discount: Per step.
        trace: Lambda of the critic's targets.
        target_keep: Share of the target critic that stays at an update.
        critic_passes, critic_parts: Over the window's data, each in so many parts.
        warm_up: Windows at the start that train the critic alone: the actor follows its slope.
        exploration: First standard deviation of commands; learnt.
        clip: Largest norm of a gradient.
        max_bad: As for ``GradientOptions``.
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


class Critic(nn.Module):
    """Value of an observation, scaled so that a mean reward per step of 1 is an output of 1.

    It starts near zero everywhere: the actor follows its slope from the first window on, and random
    values of tens of rewards would outweigh the rewards of a window.

    Args:
        num_observations: Width of normalised observations.
        discount: Per step; values are up to 1 / (1 - discount) times a reward.
        seed: Of the weights.
    """

    def __init__(self, num_observations: int, discount: float, seed: int):
        super().__init__()
        self.scale = 1.0 / (1.0 - discount)
        net = MLPController(num_observations, 1, normalise=False, seed=seed)
        self.layers = net.layers[:-1]  # a value is not bounded: no tanh at the end

    def forward(self, normalised: Tensor) -> Tensor:
        """(..., num_observations) -> (...)."""
        value: Tensor = self.layers(normalised)[..., 0]
        return self.scale * value


def td_lambda_targets(
    rewards: Tensor,
    next_values: Tensor,
    failed: Tensor,
    ended: Tensor,
    *,
    discount: float,
    trace: float,
) -> Tensor:
    """Targets of the critic, (steps, batch).

    G_t = r_t + discount ((1 - trace) V_{t+1} + trace G_{t+1}); an episode that ends (``ended``,
    whether by failure or by time) or a window that ends takes V_{t+1} alone, a failure nothing.

    Args:
        rewards: (steps, batch).
        next_values: Target critic's value of the state after each step, before any restart.
        failed: Episodes ending for a reason of physics: nothing comes after them.
        ended: Episodes ending for whatever reason.
        discount, trace: See above.
    """
    bootstrap = torch.where(failed, torch.zeros_like(next_values), next_values)
    out = torch.empty_like(rewards)
    follow = bootstrap[-1]
    for t in reversed(range(len(rewards))):
        mixed = (1.0 - trace) * bootstrap[t] + trace * follow
        follow = rewards[t] + discount * torch.where(ended[t], bootstrap[t], mixed)
        out[t] = follow
    return out


@dataclass
class Window:
    """What one window saw, without gradient: (steps, batch, ...)."""

    normalised: Tensor
    rewards: Tensor
    next_values: Tensor
    failed: Tensor
    ended: Tensor


class ShacLearner:
    """Actor and critic.

    Args:
        setup: Task and seed.
        options: Of the method.
    """

    def __init__(self, setup: Setup, options: ShacOptions | None = None):
        self.options = o = options or ShacOptions()
        self.task: Task = setup.make_task()
        self.net = first_controller(self.task, setup.seed, setup.warm_up)
        assert self.net.normaliser is not None  # of first_controller
        self.normaliser = self.net.normaliser
        spread = torch.full((self.task.num_actions,), math.log(o.exploration)).double()
        self.log_spread = nn.Parameter(spread)
        self.critic = Critic(self.task.num_observations, o.discount, setup.seed)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.actor_adam = torch.optim.Adam(
            [*self.net.parameters(), self.log_spread], lr=o.actor_rate, betas=(0.7, 0.95)
        )
        self.critic_adam = torch.optim.Adam(
            self.critic.parameters(), lr=o.critic_rate, betas=(0.7, 0.95)
        )
        self.rng = np.random.default_rng([setup.seed, 3])
        self.windows = 0
        self.guard = NanGuard(o.max_bad)
        self.state = self.task.start(o.batch, self.rng)
        # so that episodes do not all end in the same window
        self.state["step"] = torch.from_numpy(self.rng.integers(0, self.task.max_steps, o.batch))

    def controller(self) -> nn.Module:
        """See ``Learner``."""
        return self.net

    def update(self, progress: float) -> Update:
        """One window, one step of the actor, a few passes of the critic."""
        o = self.options
        set_rate(self.actor_adam, cosine_rate(o.actor_rate, progress))
        set_rate(self.critic_adam, cosine_rate(o.critic_rate, progress))
        self.actor_adam.zero_grad()
        loss, norm, window = None, None, None
        before = self.state
        try:
            loss, window = self._window()
            loss.backward()  # type: ignore[no-untyped-call]
            norm = nn.utils.clip_grad_norm_([*self.net.parameters(), self.log_spread], o.clip)
        except (ArithmeticError, RuntimeError, ValueError) as error:
            if not broke_down(error):
                raise
        if self.guard.good(loss, norm):
            assert window is not None  # of good updates
            if self.windows >= o.warm_up:
                self.actor_adam.step()
            self._fit_critic(window)
        else:
            self.state = self.task.start(len(before["step"]), self.rng)
        self.windows += 1
        steps = o.window * o.batch
        scalars = {
            "train/reward": math.nan if window is None else float(window.rewards.mean()),
            "train/gradient_norm": math.nan if norm is None else float(norm),
            "train/exploration": float(self.log_spread.detach().exp().mean()),
            "train/bad_updates": float(self.guard.total),
        }
        return Update(steps, steps, scalars)

    def _window(self) -> tuple[Tensor, Window]:
        """Roll all episodes on; minus the mean of their discounted rewards and values after."""
        o = self.options
        state, total = detached(self.state), torch.zeros(o.batch, dtype=torch.float64)
        weight = torch.ones(o.batch, dtype=torch.float64)  # discount since the window's start
        seen, record = [], []
        for k in range(o.window):
            observation = self.task.observe(state)
            seen.append(observation.detach())
            state, reward = self.task.step(state, self._explore(observation))
            total = total + weight * reward
            weight = weight * o.discount
            after = self.task.observe(state)
            value = self.target(self.normaliser(after))
            failed = self.task.failed(detached(state))
            ended = failed | (state["step"] >= self.task.max_steps)
            stop = ended if k < o.window - 1 else torch.ones_like(ended)
            # a time limit is not a death: what would have come still counts
            total = total + torch.where(stop & ~failed, weight * value, torch.zeros_like(value))
            record.append((reward.detach(), value.detach(), failed, ended))
            state, weight = self._restart(state, weight, ended)
        self.state = detached(state)
        rows = torch.stack(seen)
        with torch.no_grad():
            normalised = self.normaliser(rows)
        self.normaliser.update(rows)
        columns = [torch.stack(list(c)) for c in zip(*record, strict=True)]
        return -total.mean() / o.window, Window(normalised, *columns)

    def _explore(self, observation: Tensor) -> Tensor:
        """Commands with learnt noise, before the bounds."""
        mean: Tensor = self.net(observation)
        noise = torch.from_numpy(self.rng.standard_normal(tuple(mean.shape)))
        return mean + noise * self.log_spread.exp()

    def _restart(self, state: TaskState, weight: Tensor, ended: Tensor) -> tuple[TaskState, Tensor]:
        """Ended episodes start anew; their later rewards count in full."""
        if not bool(ended.any()):
            return state, weight
        fresh = self.task.start(len(ended), self.rng)
        return where(ended, fresh, state), torch.where(ended, torch.ones_like(weight), weight)

    def _fit_critic(self, window: Window) -> None:
        o = self.options
        goals = td_lambda_targets(
            window.rewards,
            window.next_values,
            window.failed,
            window.ended,
            discount=o.discount,
            trace=o.trace,
        ).flatten()
        rows = window.normalised.flatten(0, 1)
        for _ in range(o.critic_passes):
            order = torch.from_numpy(self.rng.permutation(len(rows)))
            for part in order.chunk(o.critic_parts):
                self.critic_adam.zero_grad()
                error = (self.critic(rows[part]) - goals[part]) / self.critic.scale
                error.square().mean().backward()
                nn.utils.clip_grad_norm_(self.critic.parameters(), o.clip)
                self.critic_adam.step()
        with torch.no_grad():
            for old, new in zip(self.target.parameters(), self.critic.parameters(), strict=True):
                old.lerp_(new, 1.0 - o.target_keep)

    def _modules(self) -> dict[str, Any]:
        return {
            "net": self.net,
            "critic": self.critic,
            "target": self.target,
            "actor_adam": self.actor_adam,
            "critic_adam": self.critic_adam,
        }

    def state_dict(self) -> dict[str, Any]:
        """See ``Learner``."""
        return {name: part.state_dict() for name, part in self._modules().items()} | {
            "log_spread": self.log_spread.detach().clone(),
            "rng": rng_state(self.rng),
            "windows": self.windows,
            "bad": [self.guard.total, self.guard.in_a_row],
            "state": dict(self.state),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See ``Learner``."""
        for name, part in self._modules().items():
            part.load_state_dict(state[name])
        with torch.no_grad():
            self.log_spread.copy_(state["log_spread"])
        set_rng_state(self.rng, state["rng"])
        self.windows = state["windows"]
        self.guard.total, self.guard.in_a_row = state["bad"]
        self.state = state["state"]
