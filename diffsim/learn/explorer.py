"""How short-horizon methods explore, and what they are paid for it."""

from __future__ import annotations

import math

from torch import Tensor, nn

from diffsim.control import MLPController


class Explorer(nn.Module):
    """Draws commands about the controller's; its parameters are trained with the controller's."""

    def draw(self, net: MLPController, observation: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Commands (batch, num_actions), and the entropy (batch,) of their distribution [nat].

        Args:
            net: Controller whose actions are drawn.
            observation: (batch, num_observations).
            noise: Standard normal, (batch, num_actions).
        """
        raise NotImplementedError

    def bonus(self, entropy: Tensor) -> Tensor | float:
        """What an entropy (...) adds to a step's reward: nothing, unless a method says more."""
        return 0.0

    def adapt(self, entropy: Tensor) -> None:
        """Learn from a window's entropies (steps, batch) what no gradient of the actor does."""

    def scalars(self) -> dict[str, float]:
        """For the log, by name."""
        return {}


def normal_entropy(log_spread: Tensor) -> Tensor:
    """Entropy (...) of independent normal numbers of log standard deviations (..., n) [nat].

    The sum of ln(sigma) + ln(2 pi e) / 2 (Cover and Thomas, Elements of Information Theory, 8.1).
    """
    return (log_spread + 0.5 * math.log(2.0 * math.pi * math.e)).sum(-1)
