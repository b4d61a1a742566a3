"""Critics of short-horizon methods: what an observation is worth, learned from windows."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor, nn

from diffsim.control import MLPController
from diffsim.learn.adam import Adam

_SEED_STEP = 10_000  # between the weights of one critic and the next


class Critic(nn.Module):
    """Value of an observation, scaled so that a mean reward per step of 1 is an output of 1.

    It starts near zero everywhere: the actor follows its slope from the first window on, and random
    values of tens of rewards would outweigh the rewards of a window.

    Args:
        num_observations: Width of normalized observations.
        discount: Per step; values are up to 1 / (1 - discount) times a reward.
        seed: Seed of the weights.
    """

    def __init__(self, num_observations: int, discount: float, seed: int):
        super().__init__()
        self.scale = 1.0 / (1.0 - discount)
        net = MLPController(num_observations, 1, normalize=False, seed=seed)
        self.layers = net.layers[:-1]  # a value is not bounded: no tanh at the end

    def forward(self, normalized: Tensor) -> Tensor:
        """(..., num_observations) -> (...)."""
        value: Tensor = self.layers(normalized)[..., 0]
        return self.scale * value


class Critics(nn.Module):
    """Critics of the same values from different first weights, and copies that follow them.

    Args:
        num_observations, discount, seed: The same as for ``Critic``; the first has ``seed`` itself.
        count: Number of critics.
    """

    def __init__(self, num_observations: int, discount: float, seed: int, count: int):
        super().__init__()
        self.members = nn.ModuleList(
            Critic(num_observations, discount, seed + _SEED_STEP * k) for k in range(count)
        )
        self.targets = copy.deepcopy(self.members).requires_grad_(False)

    def values(self, normalized: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of the copies' values, (...), and the lowest of them, without gradient.

        The actor climbs the mean, critics learn from the lowest (Xing et al. 2025).
        """
        values = torch.stack([target(normalized) for target in self.targets])
        return values.mean(0), values.detach().amin(0)

    def fit(
        self,
        adam: Adam,
        rows: Tensor,
        goals: Tensor,
        rng: np.random.Generator,
        *,
        passes: int,
        parts: int,
        clip: float,
    ) -> None:
        """Least squares by Adam, every critic on the same goals.

        Args:
            adam: Optimizer of ``members``.
            rows: (n, num_observations), normalized.
            goals: (n,).
            rng: Generator of the order of rows.
            passes, parts: Over all rows, each in so many parts.
            clip: Largest norm of a gradient.
        """
        for _ in range(passes):
            order = torch.from_numpy(rng.permutation(len(rows)))
            for part in order.chunk(parts):
                adam.zero_grad()
                for critic in self.members:
                    error = (critic(rows[part]) - goals[part]) / critic.scale
                    error.square().mean().backward()
                nn.utils.clip_grad_norm_(self.members.parameters(), clip)
                adam.step()

    @torch.no_grad()
    def follow(self, keep: float) -> None:
        """Move the copies towards the critics; ``keep`` is the share of them that stays."""
        for old, new in zip(self.targets.parameters(), self.members.parameters(), strict=True):
            old.lerp_(new, 1.0 - keep)


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
        discount, trace: Factors of the formula above.
    """
    bootstrap = torch.where(failed, torch.zeros_like(next_values), next_values)
    out = torch.empty_like(rewards)
    follow = bootstrap[-1]
    for t in reversed(range(len(rewards))):
        mixed = (1.0 - trace) * bootstrap[t] + trace * follow
        follow = rewards[t] + discount * torch.where(ended[t], bootstrap[t], mixed)
        out[t] = follow
    return out
