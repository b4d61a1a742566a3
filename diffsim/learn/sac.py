"""SAC of stable-baselines3, from the same first controller as the gradient methods.

Its policy is a tanh of a Gaussian; rated is the tanh of the mean, which is an ``MLPController``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from stable_baselines3 import SAC
from torch import nn

from diffsim.core.checked import checked
from diffsim.learn.setup import Setup
from diffsim.learn.stable_baselines3 import Sb3Learner

_BUFFER = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@checked
@dataclass(frozen=True)
class SacOptions:
    """Options of ``SacLearner``.

    Attributes:
        envs: Members of the vector environment.
        rollout: Steps of each between two rounds of training.
        passes: Steps of Adam per such round.
        minibatch: Transitions per step of Adam.
        learning_rate: Rate of actor, critics and temperature.
        discount: Weight of a reward per step that it comes later.
        keep: Number of transitions that are remembered.
        first: Transitions under random commands before training begins.
        soft: Share of the critics that enters the target ones per step of Adam.
        exploration: First standard deviation before the tanh.
    """

    envs: int = 16
    rollout: int = 8
    passes: int = 64
    minibatch: int = 256
    learning_rate: float = 1e-3
    discount: float = 0.99
    keep: int = 200_000
    first: int = 1_000
    soft: float = 0.005
    exploration: float = 0.5


class SacLearner(Sb3Learner):
    """stable-baselines3's SAC, one round of collecting and training per update.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    algorithm: type[Any] = SAC

    @checked
    def __init__(self, setup: Setup, options: SacOptions | None = None):
        super().__init__(setup, options or SacOptions(), norm_reward=False)
        with torch.no_grad():
            spread: Any = self.model.actor.log_std
            spread.weight.zero_()
            spread.bias.fill_(float(np.log(self.options.exploration)))

    def _make_model(self, seed: int) -> Any:
        o = self.options
        return self.algorithm(
            "MlpPolicy",
            self.venv,
            learning_rate=o.learning_rate,
            buffer_size=o.keep,
            learning_starts=o.first,
            batch_size=o.minibatch,
            tau=o.soft,
            gamma=o.discount,
            train_freq=(o.rollout, "step"),
            gradient_steps=o.passes,
            seed=seed,
            device="cpu",
            policy_kwargs={"net_arch": [64, 64], "activation_fn": nn.Tanh},
            **self._extra(),
        )

    def _extra(self) -> dict[str, Any]:
        """Further arguments of the algorithm."""
        return {}

    def _policy(self) -> tuple[nn.Module, ...]:
        return self.model.actor.latent_pi, self.model.actor.mu

    def _model_state(self) -> dict[str, Any]:
        buffer = self.model.replay_buffer
        rows = buffer.buffer_size if buffer.full else buffer.pos
        return {
            "parameters": self.model.get_parameters(),
            "log_temperature": self.model.log_ent_coef.detach().clone(),
            "buffer": {k: torch.from_numpy(getattr(buffer, k)[:rows].copy()) for k in _BUFFER},
            "place": [buffer.pos, buffer.full],
        }

    def _load_model_state(self, state: dict[str, Any]) -> None:
        self.model.set_parameters(state["parameters"])
        with torch.no_grad():
            self.model.log_ent_coef.copy_(state["log_temperature"])
        buffer = self.model.replay_buffer
        for name, rows in state["buffer"].items():
            getattr(buffer, name)[: len(rows)] = rows.numpy()
        buffer.pos, buffer.full = state["place"]
