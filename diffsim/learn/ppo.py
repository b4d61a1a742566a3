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
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from diffsim.control import MLPController
from diffsim.core.checked import checked
from diffsim.envs.sb3 import Sb3VecEnv
from diffsim.envs.task import Task
from diffsim.envs.vector_env import TaskVectorEnv
from diffsim.learn.run import Update
from diffsim.learn.setup import Setup
from diffsim.learn.stable_baselines3 import (
    as_controller,
    go_on_from,
    learn,
    linear_layers,
    moments_of,
    set_moments,
    start_from,
)


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


class PpoLearner:
    """stable-baselines3's PPO, one rollout per update.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    @checked
    def __init__(self, setup: Setup, options: PpoOptions | None = None):
        self.options = o = options or PpoOptions()
        self.task: Task = setup.make_task()
        first = setup.first_controller(self.task)
        self.venv = VecNormalize(
            Sb3VecEnv(TaskVectorEnv(self.task, o.envs)), gamma=o.discount, clip_obs=10.0
        )
        self.rate = o.learning_rate
        self.model = PPO(
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
            seed=setup.seed,
            device="cpu",
            policy_kwargs={
                "net_arch": {"pi": [64, 64], "vf": [64, 64]},
                "activation_fn": nn.Tanh,
                "ortho_init": True,
                # held noise adds up over the last layer's units, each at most 1
                "log_std_init": float(np.log(o.exploration / (8.0 if o.hold_noise else 1.0))),
            },
        )
        start_from(first, self._policy_layers(), self.venv)

    def controller(self) -> MLPController:
        """See ``Learner``."""
        return as_controller(self.task, self._policy_layers(), self.venv)

    @checked(kinds_only=True)
    def update(self, progress: float) -> Update:
        """One rollout and its epochs; the learning rate is annealed over the whole budget."""
        o = self.options
        self.rate = o.learning_rate * max(0.0, 1.0 - progress)
        return learn(self.model, o.envs * o.rollout)

    def _policy_layers(self) -> list[nn.Linear]:
        policy = self.model.policy
        return linear_layers(policy.mlp_extractor.policy_net, policy.action_net)

    def state_dict(self) -> dict[str, Any]:
        """See ``Learner``. Episodes in progress are not kept: a resumed run starts new ones."""
        return {
            "policy": self.model.policy.state_dict(),
            "optimizer": self.model.policy.optimizer.state_dict(),
            "moments": moments_of(self.venv),
            "num_timesteps": self.model.num_timesteps,
        }

    @checked(kinds_only=True)
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See ``Learner``."""
        self.model.policy.load_state_dict(state["policy"])
        self.model.policy.optimizer.load_state_dict(state["optimizer"])
        set_moments(self.venv, state["moments"])
        go_on_from(self.model, state["num_timesteps"])
