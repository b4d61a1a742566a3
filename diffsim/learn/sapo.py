"""Soft analytic policy optimization (Xing, Luk and Oh, "Stabilizing reinforcement learning in
differentiable multiphysics simulation", ICLR 2025, arXiv:2412.12089): a short-horizon actor-critic
that is paid for reward and entropy, with a spread that depends on the state, a learned price of
entropy and two critics.

Ours are the controller (tanh units, as for every method), Adam, and the temperature's first value
and rate: the authors' 1 and 5e-3 are for thousands of updates, a run here has about a hundred.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from diffsim.control import MLPController
from diffsim.core.check import require_number
from diffsim.core.checked import checked
from diffsim.envs.task import Task
from diffsim.learn.adam import Adam
from diffsim.learn.explorer import Explorer, normal_entropy
from diffsim.learn.setup import Setup
from diffsim.learn.short_horizon import ShortHorizonLearner, WindowOptions

NUM_CRITICS = 2
LOG_SPREAD_BOUNDS = (-5.0, 2.0)  # as in the authors' and in usual implementations of SAC
_SPREAD_SEED = 5_000  # added to the run's: other weights than the controller's and the critics'


@checked
@dataclass(frozen=True)
class SapoOptions(WindowOptions):
    """Options of ``SapoLearner``: those of ``WindowOptions``, and more; 0 kept: no target critics.

    Attributes:
        temperature: First reward of one unit of ``scaled_entropy``.
        temperature_rate: Learning rate of Adam on its logarithm.
        target_entropy: Wanted entropy per command [nat], negative; -1/2 is a spread of 0.15.
    """

    target_keep: float = 0.0
    temperature: float = 0.1
    temperature_rate: float = 2e-2
    target_entropy: float = -0.5

    def __post_init__(self) -> None:
        require_number("temperature", self.temperature, above=0.0)
        require_number("temperature_rate", self.temperature_rate, at_least=0.0)
        require_number("target_entropy", self.target_entropy, below=0.0)


def scaled_entropy(entropy: Tensor, target: float) -> Tensor:
    """(H - T) / (2 |T|), with T the wanted entropy: 0 where it is met, 1/2 where H is 0.

    Differential entropies of narrow distributions are negative; unscaled, a failure that ends them
    would pay (Xing et al. 2025).

    Args:
        entropy: H (...), of whole commands.
        target: Entropy T that is aimed at, negative.
    """
    return (entropy - target) / (2.0 * abs(target))


class Temperature:
    """The price of entropy, alpha; moved until the entropy is the wanted one.

    Gradient descent on alpha (H - T) in ln(alpha) (Haarnoja et al., "Soft actor-critic algorithms
    and applications", 2018, eq. 18).

    Args:
        first: At the start.
        rate: Learning rate of Adam.
        target: T, of whole commands.
    """

    def __init__(self, first: float, rate: float, target: float):
        self.target = target
        self.log = torch.tensor(math.log(first), dtype=torch.float64, requires_grad=True)
        self.adam = Adam([self.log], rate, betas=(0.7, 0.95))

    @property
    def value(self) -> float:
        """alpha."""
        return math.exp(float(self.log.detach()))

    def adapt(self, entropy: Tensor) -> None:
        """One step for entropies H (...)."""
        self.adam.zero_grad()
        loss = self.log.exp() * (entropy.detach().mean() - self.target)
        loss.backward()
        self.adam.step()

    def state_dict(self) -> dict[str, Any]:
        """Everything that changes."""
        return {"log": self.log.detach().clone(), "adam": self.adam.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state_dict``."""
        with torch.no_grad():
            self.log.copy_(state["log"])
        self.adam.load_state_dict(state["adam"])


class SoftExplorer(Explorer):
    """Normal noise before the controller's last tanh, of a spread that a second network gives.

    Args:
        task: Task whose commands are explored.
        options: Options of the method.
        seed: Seed of the second network's weights.
    """

    def __init__(self, task: Task, options: SapoOptions, seed: int):
        super().__init__()
        net = MLPController(task.num_observations, task.num_actions, normalize=False, seed=seed)
        self.log_spread = net.layers[:-1]  # no tanh at the end
        last = net.layers[-2]
        assert isinstance(last, nn.Linear)  # of MLPController
        with torch.no_grad():
            last.bias.fill_(math.log(options.exploration))
        target = options.target_entropy * task.num_actions
        self.temperature = Temperature(options.temperature, options.temperature_rate, target)

    def draw(self, net: MLPController, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """See ``Explorer``; the entropy is that of the bounded commands, estimated by this draw.

        H[tanh(u)] = H[u] + E[sum ln(1 - tanh(u)^2)] (Haarnoja et al. 2018, appendix C).
        """
        assert net.normalizer is not None  # of first_controller
        normalized = net.normalizer(observation)
        log_spread = self.log_spread(normalized).clamp(*LOG_SPREAD_BOUNDS)
        free = net.layers[:-1](normalized) + noise * log_spread.exp()
        return torch.tanh(free), normal_entropy(log_spread) + log_slope(free).sum(-1)

    def bonus(self, entropy: Tensor) -> Tensor:
        """See ``Explorer``."""
        return self.temperature.value * scaled_entropy(entropy, self.temperature.target)

    def adapt(self, entropy: Tensor) -> None:
        """See ``Explorer``."""
        self.temperature.adapt(entropy)

    def scalars(self) -> dict[str, float]:
        """See ``Explorer``."""
        return {"train/temperature": self.temperature.value}

    def get_extra_state(self) -> dict[str, Any]:
        """Part of ``state_dict``: the temperature is no parameter of the actor's Adam."""
        return self.temperature.state_dict()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Part of ``load_state_dict``."""
        self.temperature.load_state_dict(state)


def log_slope(free: Tensor) -> Tensor:
    """ln(1 - tanh(u)^2) = 2 (ln 2 - u - ln(1 + exp(-2 u))), exact where the slope vanishes."""
    return 2.0 * (math.log(2.0) - free - functional.softplus(-2.0 * free))


class SapoLearner(ShortHorizonLearner):
    """Two critics, rewards and entropy.

    Args:
        setup: Task and seed.
        options: Options of the method.
    """

    @checked
    def __init__(self, setup: Setup, options: SapoOptions | None = None):
        o = options or SapoOptions()
        seed = setup.seed + _SPREAD_SEED
        super().__init__(setup, o, lambda task: SoftExplorer(task, o, seed), NUM_CRITICS)
