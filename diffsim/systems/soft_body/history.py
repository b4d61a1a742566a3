"""Loads that a body went through before its simulation begins, for models with memory."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class History:
    """A hand held the body for long, let go, and it has swung about its sag since.

    Attributes:
        since_s: Time since the hand let go [s].
        hand_force: (num_nodes, 3) of the hand [N].
        swing_rate: () angular frequency of the swing [rad/s].
    """

    since_s: float
    hand_force: Tensor
    swing_rate: Tensor

    def memory(self, force: Tensor, weight: Tensor, tau: Tensor) -> Tensor:
        """State of the Maxwell branches when the simulation begins.

        Held: minus weight and hand. Since then the mean has been minus the weight, and of the swing
        about it a branch follows the share 1 / (1 + (w tau)^2) that is in phase. That the mean
        itself creeps, and what lags by a quarter turn, is left out: both are small of second order
        or forgotten within a few swings.

        Args:
            force: (..., num_nodes, 3) of the solid now [N].
            weight: Weight of the solid at each node, (num_nodes, 3) [N].
            tau: (num_branches,) time constants [s].

        Returns:
            (num_branches, ..., num_nodes, 3) [N].
        """
        tau = tau.reshape(-1, *(1 for _ in force.shape))
        held = torch.exp(-self.since_s / tau) * self.hand_force
        follows = 1.0 / (1.0 + (self.swing_rate * tau) ** 2)
        return follows * (force + weight) - weight - held
