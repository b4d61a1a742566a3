"""Short-horizon actor-critic (Xu et al., "Accelerated policy learning with parallel differentiable
simulation", ICLR 2022): gradients through short windows, a critic for what comes after."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from diffsim.control import MLPController
from diffsim.core.checked import checked
from diffsim.learn.explorer import Explorer, normal_entropy
from diffsim.learn.setup import Setup
from diffsim.learn.short_horizon import ShortHorizonLearner, WindowOptions


@checked
@dataclass(frozen=True)
class ShacOptions(WindowOptions):
    """Options of ``ShacLearner``: those of ``WindowOptions``."""


class FixedSpread(Explorer):
    """Normal noise before the bounds, of one learned spread per command whatever is observed.

    Args:
        num_actions: Width of a command.
        exploration: First standard deviation.
    """

    def __init__(self, num_actions: int, exploration: float):
        super().__init__()
        spread = torch.full((num_actions,), math.log(exploration)).double()
        self.log_spread = nn.Parameter(spread)

    def draw(self, net: MLPController, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """See ``Explorer``."""
        entropy = normal_entropy(self.log_spread).expand(len(noise))
        return net(observation) + noise * self.log_spread.exp(), entropy

    def scalars(self) -> dict[str, float]:
        """See ``Explorer``."""
        return {"train/exploration": float(self.log_spread.detach().exp().mean())}


class ShacLearner(ShortHorizonLearner):
    """One critic, rewards alone.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    @checked
    def __init__(self, setup: Setup, options: ShacOptions | None = None):
        o = options or ShacOptions()
        super().__init__(setup, o, lambda task: FixedSpread(task.num_actions, o.exploration), 1)
