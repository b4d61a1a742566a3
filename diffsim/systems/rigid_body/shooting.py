"""Start states of tosses as functions of all other parameters: fitted away, not searched for.

A start state of 12: position, roll-pitch-yaw, velocity, body rates, world z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# What is known of a start state beyond its first guess: hardly anything [m, rad, m/s, rad/s].
_SPREAD = torch.tensor([0.3] * 3 + [0.2] * 3 + [1.0] * 3 + [1.0] * 3, dtype=torch.float64)
_NUDGE = 1e-4 * _SPREAD / _SPREAD.max()
_CORRECTIONS = 2


@dataclass(frozen=True, eq=False)
class TossShooting:
    """Windows of one run, and how their initial states follow from what was measured.

    The initial states d (departures from the first guess) minimize
    |W (measured - predicted(d))|^2 + |d / spread|^2 by Gauss-Newton with the tangents of the model
    at its prior; they are then a smooth function of all other parameters. The prediction is the
    profile over d: misfit that an initial state can explain is no evidence for anything.

    Attributes:
        start: First guess, (num_windows, 12).
        measured: (num_windows, length, num_channels), zero where nothing was recorded.
        tangent: d predicted / d start, (num_windows, length * num_channels, 12).
        gain: Misfit to states, (num_windows, 12, length * num_channels).
    """

    start: Tensor
    measured: Tensor
    tangent: Tensor
    gain: Tensor

    @classmethod
    def prepare(
        cls, predict: Callable[[Tensor], Tensor], start: Tensor, measured: Tensor, sd: Tensor
    ) -> TossShooting:
        """Tangents by central differences.

        Args:
            predict: Starts (n * num_windows, 12), windows fastest, -> channels
                (n * num_windows, length, num_channels).
            start: First guess, (num_windows, 12).
            measured: (num_windows, length, num_channels), NaN where nothing was recorded.
            sd: Noise of the channels, (num_channels,).
        """
        windows, length, channels = measured.shape
        nudges = torch.diag(_NUDGE)
        moved = torch.cat([start + s * n for n in nudges for s in (1.0, -1.0)])
        with torch.no_grad():
            there = predict(moved).reshape(12, 2, windows, length * channels)
        tangent = (there[:, 0] - there[:, 1]) / (2.0 * _NUDGE[:, None, None])
        tangent = tangent.permute(1, 2, 0).contiguous()
        weight = (torch.isfinite(measured) / sd**2).reshape(windows, -1, 1)
        normal = tangent.mT @ (weight * tangent) + torch.diag(_SPREAD**-2)
        gain = torch.linalg.solve(normal, (weight * tangent).mT)
        return cls(start, measured.nan_to_num(0.0), tangent, gain)

    def profile(self, predict: Callable[[Tensor], Tensor], many: int) -> Tensor:
        """Predictions with the best initial states.

        Args:
            predict: Starts (many, num_windows, 12) -> channels of the same leading axes.
            many: Number of models that ``predict`` flies at once.

        Returns:
            (many, num_windows, length, num_channels).
        """
        windows, length, channels = self.measured.shape
        change = torch.zeros(many, windows, 12, 1, dtype=torch.float64)
        measured = self.measured.reshape(windows, -1, 1)
        for k in range(_CORRECTIONS + 1):
            here = predict(self.start + change[..., 0]).reshape(many, windows, -1, 1)
            better = self.gain @ (measured - here + self.tangent @ change)
            if k == _CORRECTIONS:
                here = here + self.tangent @ (better - change)
            change = better
        return here.reshape(many, windows, length, channels)
