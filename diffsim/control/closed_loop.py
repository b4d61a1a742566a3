"""Closed-loop controllers: networks of what is sensed. Any ``nn.Module`` of the same call works."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from diffsim.core.check import all_finite, require, require_constant, require_count, require_number
from diffsim.core.checked import checked
from diffsim.core.numbers import require_unmapped


class Normalizer(nn.Module):
    """Observations to zero mean and unit variance, from running moments (Chan et al. 1983).

    Moments change in ``update`` only, so that a rollout is differentiable and repeatable.

    Args:
        size: Number of observations.
        clip: Normalized observations are cut at plus and minus this.
    """

    mean: Tensor
    variance: Tensor
    count: Tensor

    def __init__(self, size: int, clip: float = 10.0):
        super().__init__()
        size = require_count("size", size, at_least=1)
        self.clip = require_number("clip", clip, above=0.0)
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    @torch.no_grad()
    def update(self, observations: Tensor) -> None:
        """Take more observations (..., size) into account; none change nothing.

        Raises:
            TypeError: no float64 tensor.
            ValueError: another size, or entries that are not finite, or too large for a variance.
        """
        observations = require("observations", observations, ("...", len(self.mean)))
        rows = observations.reshape(-1, len(self.mean))
        if not len(rows):
            return
        new = float(len(rows))
        total = self.count + new
        away = rows.mean(0) - self.mean
        squares = (
            self.variance * self.count
            + rows.var(0, unbiased=False) * new
            + away.square() * self.count * new / total
        )
        require_unmapped(observations=observations)
        if not all_finite(squares):
            raise ValueError(
                "observations must leave room for their squares in float64, got up to "
                f"{float(rows.abs().max()):.3g}; choose another unit, or look for what ran away"
            )
        self.mean += away * new / total
        self.variance.copy_(squares / total)
        self.count.copy_(total)

    def forward(self, observation: Tensor) -> Tensor:
        """Normalized, (..., size)."""
        require("observation", observation, ("...", len(self.mean)), self.mean.dtype)
        scaled = (observation - self.mean) / (self.variance + 1e-8).sqrt()
        return scaled.clamp(-self.clip, self.clip)


class MLPController(nn.Module):
    """Multilayer perceptron with tanh throughout, so that commands lie in (-1, 1).

    Three layers of weights with 64 hidden units (thesis 4.1.6): 411 inputs and 4 outputs make the
    starfish's 30,788 parameters, 285 and 1 the shark's 22,529. Weights are orthogonal, the last
    layer's a hundred times smaller, so that a new controller hardly moves.

    Args:
        num_observations, num_commands: Width of input and output.
        hidden: Units of the hidden layers.
        normalize: Whether observations pass a ``Normalizer``.
        seed: Seed of the weights.
        output_gain: Gain of the last layer's weights.
        input_gains: Factors on the first layer's weights, one per observation; None: ones.
    """

    @checked
    def __init__(
        self,
        num_observations: int,
        num_commands: int,
        *,
        hidden: Sequence[int] = (64, 64),
        normalize: bool = True,
        seed: int = 0,
        output_gain: float = 0.01,
        input_gains: Tensor | None = None,
    ):
        super().__init__()
        sizes = [num_observations, *hidden, num_commands]
        for k, size in enumerate(sizes):
            name = {0: "num_observations", len(sizes) - 1: "num_commands"}.get(k, "hidden")
            require_count(name, size, at_least=1)
        self.normalizer = Normalizer(num_observations) if normalize else None
        generator = torch.Generator().manual_seed(seed)
        layers: list[nn.Module] = []
        for k, (a, b) in enumerate(pairwise(sizes)):
            layer = nn.Linear(a, b, dtype=torch.float64)
            last = k == len(sizes) - 2
            gain = output_gain if last else 2.0**0.5
            nn.init.orthogonal_(layer.weight, gain=gain, generator=generator)
            nn.init.zeros_(layer.bias)
            layers += [layer, nn.Tanh()]
        self.layers = nn.Sequential(*layers)
        require_constant("input_gains", input_gains, "weights are trained from them on")
        if input_gains is not None:
            gains = require("input_gains", input_gains, (num_observations,))
            with torch.no_grad():
                first = next(layer for layer in layers if isinstance(layer, nn.Linear))
                first.weight.mul_(gains)

    @property
    def num_parameters(self) -> int:
        """Trained numbers."""
        return sum(p.numel() for p in self.parameters())

    def forward(self, observation: Tensor, step: int | Tensor = 0) -> Tensor:
        """Commands (..., num_commands)."""
        of_weights = next(self.layers.parameters()).dtype
        width = next(self.layers.parameters()).shape[1]
        if isinstance(observation, Tensor) and observation.dtype != of_weights:
            raise TypeError(
                f"observation is {observation.dtype}, the controller's weights are {of_weights}; "
                f"convert one of them, such as by controller.to({observation.dtype})"
            )
        observation = require("observation", observation, ("...", width), of_weights)
        x = observation if self.normalizer is None else self.normalizer(observation)
        out: Tensor = self.layers(x)
        return out
