"""What methods of stable-baselines3 share: the same first controller, normalized observations."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from diffsim.control import MLPController
from diffsim.core.checked import checked
from diffsim.envs.sb3 import Sb3VecEnv
from diffsim.envs.task import Task
from diffsim.envs.vector_env import TaskVectorEnv
from diffsim.learn.run import Update
from diffsim.learn.setup import Setup


class Sb3Learner:
    """What its learners do alike; each of them says what its model is and what of it is kept."""

    model: Any

    def __init__(self, setup: Setup, options: Any, *, norm_reward: bool = True):
        self.options = options
        self.task: Task = setup.make_task()
        first = setup.first_controller(self.task)
        self.venv = VecNormalize(
            Sb3VecEnv(TaskVectorEnv(self.task, options.envs)),
            gamma=options.discount,
            clip_obs=10.0,
            norm_reward=norm_reward,
        )
        self.model = self._make_model(setup.seed)
        self._start_from(first)

    def _make_model(self, seed: int) -> Any:
        """The algorithm on ``venv``."""
        raise NotImplementedError

    def _policy(self) -> tuple[nn.Module, ...]:
        """Modules whose linear layers make the mean command, in order."""
        raise NotImplementedError

    def _model_state(self) -> dict[str, Any]:
        """What a checkpoint keeps of the model."""
        raise NotImplementedError

    def _load_model_state(self, state: dict[str, Any]) -> None:
        """Undo ``_model_state``."""
        raise NotImplementedError

    def _start_from(self, first: MLPController) -> None:
        """Give the policy a controller's weights, and the environment its moments."""
        assert first.normalizer is not None  # of first_controller
        with torch.no_grad():
            for ours, theirs in self._pairs(first):
                theirs.weight.copy_(ours.weight)
                theirs.bias.copy_(ours.bias)
        moments: Any = self.venv.obs_rms
        moments.mean = first.normalizer.mean.numpy().copy()
        moments.var = first.normalizer.variance.numpy().copy()
        moments.count = float(first.normalizer.count)

    def controller(self) -> MLPController:
        """The policy's mean in double precision, observations normalized alike."""
        net = MLPController(self.task.num_observations, self.task.num_actions)
        moments: Any = self.venv.obs_rms
        assert net.normalizer is not None  # asked for by default
        with torch.no_grad():
            for ours, theirs in self._pairs(net):
                ours.weight.copy_(theirs.weight)
                ours.bias.copy_(theirs.bias)
            net.normalizer.mean.copy_(torch.as_tensor(moments.mean))
            net.normalizer.variance.copy_(torch.as_tensor(moments.var))
            net.normalizer.count.copy_(torch.as_tensor(moments.count))
        return net

    def _pairs(self, net: MLPController) -> Iterator[tuple[nn.Linear, nn.Linear]]:
        """A controller's layers and the policy's."""
        return zip(_linear_layers(net.layers), _linear_layers(*self._policy()), strict=True)

    @checked(kinds_only=True)
    def update(self, progress: float) -> Update:
        """One rollout of all members, and the training on it."""
        return learn(self.model, self.options.envs * self.options.rollout)

    def state_dict(self) -> dict[str, Any]:
        """See ``Learner``. Episodes in progress are not kept: a resumed run starts new ones."""
        moments = {}
        for name in ("obs_rms", "ret_rms"):
            rms = getattr(self.venv, name)
            # copies: the environment goes on to change its own in place
            mean, var = torch.as_tensor(rms.mean).clone(), torch.as_tensor(rms.var).clone()
            moments[name] = [mean, var, float(rms.count)]
        return self._model_state() | {"moments": moments, "num_timesteps": self.model.num_timesteps}

    @checked(kinds_only=True)
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """See ``Learner``; a seed draws other episodes than the first."""
        self._load_model_state(state)
        for name, (mean, var, count) in state["moments"].items():
            rms = getattr(self.venv, name)
            rms.mean, rms.var, rms.count = mean.numpy().copy(), var.numpy().copy(), count
        self.model.num_timesteps = state["num_timesteps"]
        self.model.set_random_seed(self.model.seed + state["num_timesteps"])


def _linear_layers(*modules: nn.Module) -> list[nn.Linear]:
    """Linear layers in order."""
    return [m for module in modules for m in module.modules() if isinstance(m, nn.Linear)]


def learn(model: Any, steps: int) -> Update:
    """Let a model take ``steps`` steps and train on them; its own figures are the update's."""
    model.set_logger(Logger(folder=None, output_formats=[]))  # its own would leave a folder each
    model.learn(total_timesteps=steps, reset_num_timesteps=False)
    values = model.logger.name_to_value
    return Update(steps, 0, {k: float(v) for k, v in values.items() if k.startswith("train/")})
