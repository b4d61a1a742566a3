"""PPO of stable-baselines3, from the same first controller as the gradient methods.

With the code-level optimizations of Engstrom et al. ("Implementation matters in deep policy
gradients", ICLR 2020): value clipping, scaled rewards, normalized and clipped observations and
rewards, orthogonal first weights, annealed learning rate, clipped gradients, tanh units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from diffsim.core.checked import checked
from diffsim.learn.run import Update
from diffsim.learn.setup import Setup
from diffsim.learn.stable_baselines3 import Sb3Learner


@checked
@dataclass(frozen=True)
class PpoOptions:
    """Options of ``PpoLearner``.

    Attributes:
        envs: Members of the vector environment.
        rollout: Steps of each between updates.
        minibatch: Rows per step of Adam.
        epochs: Passes over a rollout.
        learning_rate: At the start; falls to zero linearly.
        discount, trace: Discount and trace decay of generalized advantage estimation.
        clip: Clipping range of the policy's ratio and of the value.
        entropy: Weight of the bonus.
        exploration: First standard deviation of commands; learned.
        hold_noise: Steps for which noise stays one function of the state (gSDE, Raffin et al.
            2021), so that it moves slow bodies; 0: white noise.
    """

    envs: int = 16
    rollout: int = 128
    minibatch: int = 256
    epochs: int = 10
    learning_rate: float = 3e-4
    discount: float = 0.99
    trace: float = 0.95
    clip: float = 0.2
    entropy: float = 0.0
    exploration: float = 0.5
    hold_noise: int = 0


class TanhMeanPolicy(ActorCriticPolicy):
    """Mean commands pass a tanh, as those of ``MLPController`` do."""

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        # the optimizer made there keeps its parameters: a tanh has none
        self.action_net = nn.Sequential(self.action_net, nn.Tanh())


class PpoLearner(Sb3Learner):
    """stable-baselines3's PPO, one rollout per update.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    @checked
    def __init__(self, setup: Setup, options: PpoOptions | None = None):
        options = options or PpoOptions()
        self.rate = options.learning_rate
        super().__init__(setup, options)

    def _make_model(self, seed: int) -> PPO:
        o = self.options
        return PPO(
            TanhMeanPolicy,
            self.venv,
            learning_rate=lambda _: self.rate,
            n_steps=o.rollout,
            batch_size=o.minibatch,
            n_epochs=o.epochs,
            gamma=o.discount,
            gae_lambda=o.trace,
            clip_range=o.clip,
            clip_range_vf=o.clip,
            ent_coef=o.entropy,
            use_sde=o.hold_noise > 0,
            sde_sample_freq=o.hold_noise or -1,
            seed=seed,
            device="cpu",
            policy_kwargs={
                "net_arch": {"pi": [64, 64], "vf": [64, 64]},
                "activation_fn": nn.Tanh,
                "ortho_init": True,
                # held noise adds up over the last layer's units, each at most 1
                "log_std_init": float(np.log(o.exploration / (8.0 if o.hold_noise else 1.0))),
            },
        )

    def _policy(self) -> tuple[nn.Module, ...]:
        policy = self.model.policy
        return policy.mlp_extractor.policy_net, policy.action_net

    @checked(kinds_only=True)
    def update(self, progress: float) -> Update:
        """One rollout and its epochs; the learning rate is annealed over the whole budget."""
        self.rate = self.options.learning_rate * max(0.0, 1.0 - progress)
        return super().update(progress)

    def _model_state(self) -> dict[str, Any]:
        policy = self.model.policy
        return {"policy": policy.state_dict(), "optimizer": policy.optimizer.state_dict()}

    def _load_model_state(self, state: dict[str, Any]) -> None:
        self.model.policy.load_state_dict(state["policy"])
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
