"""What methods of stable-baselines3 share: the same first controller, normalized observations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from diffsim.control import MLPController
from diffsim.envs.task import Task
from diffsim.learn.run import Update


def linear_layers(*modules: nn.Module) -> list[nn.Linear]:
    """Linear layers in order."""
    return [m for module in modules for m in module.modules() if isinstance(m, nn.Linear)]


def start_from(first: MLPController, layers: Sequence[nn.Linear], venv: VecNormalize) -> None:
    """Give a policy's layers the weights, and its environment the moments, of a controller."""
    assert first.normalizer is not None  # of first_controller
    with torch.no_grad():
        for ours, theirs in zip(linear_layers(first.layers), layers, strict=True):
            theirs.weight.copy_(ours.weight)
            theirs.bias.copy_(ours.bias)
    moments: Any = venv.obs_rms
    moments.mean = first.normalizer.mean.numpy().copy()
    moments.var = first.normalizer.variance.numpy().copy()
    moments.count = float(first.normalizer.count)


def as_controller(task: Task, layers: Sequence[nn.Linear], venv: VecNormalize) -> MLPController:
    """A policy's mean as a controller in double precision, observations normalized alike."""
    net = MLPController(task.num_observations, task.num_actions)
    moments: Any = venv.obs_rms
    assert net.normalizer is not None  # asked for by default
    with torch.no_grad():
        for ours, theirs in zip(linear_layers(net.layers), layers, strict=True):
            ours.weight.copy_(theirs.weight)
            ours.bias.copy_(theirs.bias)
        net.normalizer.mean.copy_(torch.as_tensor(moments.mean))
        net.normalizer.variance.copy_(torch.as_tensor(moments.var))
        net.normalizer.count.copy_(torch.as_tensor(moments.count))
    return net


def moments_of(venv: VecNormalize) -> dict[str, list[Any]]:
    """Running moments of observations and returns, for a checkpoint."""
    out = {}
    for name in ("obs_rms", "ret_rms"):
        rms = getattr(venv, name)
        # copies: the environment goes on to change its own in place
        mean, var = torch.as_tensor(rms.mean).clone(), torch.as_tensor(rms.var).clone()
        out[name] = [mean, var, float(rms.count)]
    return out


def set_moments(venv: VecNormalize, moments: dict[str, list[Any]]) -> None:
    """Undo ``moments_of``."""
    for name, (mean, var, count) in moments.items():
        rms = getattr(venv, name)
        rms.mean, rms.var, rms.count = mean.numpy().copy(), var.numpy().copy(), count


def learn(model: Any, steps: int) -> Update:
    """Let a model take ``steps`` steps and train on them; its own figures are the update's."""
    model.set_logger(Logger(folder=None, output_formats=[]))  # its own would leave a folder each
    model.learn(total_timesteps=steps, reset_num_timesteps=False)
    values = model.logger.name_to_value
    return Update(steps, 0, {k: float(v) for k, v in values.items() if k.startswith("train/")})


def go_on_from(model: Any, num_timesteps: int) -> None:
    """Set a loaded model's count of steps, and a seed that draws other episodes than the first."""
    model.num_timesteps = num_timesteps
    model.set_random_seed(model.seed + num_timesteps)
