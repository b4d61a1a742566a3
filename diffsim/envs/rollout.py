"""Differentiable episodes: a controller steers a task, and the reward knows its gradient."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.envs.task import Task, TaskState, detached

Controller = Callable[[Tensor, int], Tensor]
"""Observation (batch, n) and step -> action (batch, m); any ``nn.Module`` of this call."""


class Episode(NamedTuple):
    """What a rollout returns.

    Attributes:
        rewards: (num_steps, batch); zero once an episode has failed.
        alive: (num_steps, batch) bool: whether the episode had not failed before the step.
        observations: (num_steps, batch, num_observations), without gradient.
        final: State after the last step, with gradient.
    """

    rewards: Tensor
    alive: Tensor
    observations: Tensor
    final: TaskState


def rollout_task(
    task: Task,
    controller: Controller,
    state: TaskState,
    num_steps: int,
    *,
    cut_every: int | None = None,
) -> Episode:
    """Steer a task for some steps.

    Args:
        controller: Gives the commands.
        state: (batch, ...) from ``task.start``.
        num_steps: Number of steps; above ``task.max_steps`` it makes no sense.
        cut_every: Forget gradients of the state every so many steps: a truncated horizon for
            dynamics whose gradients explode.

    Returns:
        ``Episode``. Gradients: the controller's parameters, the first state.
    """
    if cut_every is not None and cut_every < 1:
        raise ValueError(f"cut_every must be None or at least 1, got {cut_every}")
    rewards, alive, seen = [], [], []
    going = torch.ones(state["step"].shape[0], dtype=torch.bool)
    for k in range(num_steps):
        if cut_every is not None and k and k % cut_every == 0:
            state = detached(state)
        observation = task.observe(state)
        state, reward = task.step(state, controller(observation, k))
        rewards.append(torch.where(going, reward, torch.zeros_like(reward)))
        alive.append(going)
        seen.append(observation.detach())
        with torch.no_grad():
            going = going & ~task.failed(state)
    return Episode(torch.stack(rewards), torch.stack(alive), torch.stack(seen), state)
