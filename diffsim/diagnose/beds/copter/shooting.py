"""Multiple shooting: a flight cut into windows whose initial states are fitted away.

The state of 12 here: position, roll-pitch-yaw, velocity (world), body rates, world NED.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.signal import savgol_filter
from torch import Tensor

from diffsim.copter import FlightState
from diffsim.copter.attitude import body_rates_from_rpy_rates, quaternion_from_rpy

RIGID = 12  # entries of the rigid body's state; thrusts held before the record follow
# What is known of an initial state beyond its first guess: hardly anything.
_SPREAD = (0.3, 0.2, 1.0, 1.0)  # [m, rad, m/s, rad/s]
_PAST_SPREAD = 1.0  # of the thrusts before the record [N]
_NUDGE = 1e-4  # of the spread
_SMOOTH_S = 0.15  # over which position is differentiated
_CORRECTIONS = 3  # flights; a last one is linear


def flight_state(x12: Tensor) -> FlightState:
    """States of 12, (batch, 12), as starts of flights."""
    position, rpy, velocity, rates = (part.contiguous() for part in x12.split(3, -1))
    return FlightState(position, quaternion_from_rpy(rpy), velocity, rates)


def guess_states(position: Tensor, rpy: Tensor, rates: Tensor | None, dt: float) -> Tensor:
    """States of 12 at every sample, from noisy records (num_samples, 3) each.

    Velocity is the slope of a quadratic fitted over 0.15 s; body rates, if there is no gyro, the
    same of roll, pitch and yaw.
    """
    width = min(max(5, 2 * round(0.5 * _SMOOTH_S / dt) + 1), (position.shape[0] - 1) // 2 * 2 + 1)
    if width < 5:
        raise ValueError(f"a flight needs five samples or more, got {position.shape[0]}")

    def slope(values: Tensor) -> Tensor:
        return torch.from_numpy(savgol_filter(values.numpy(), width, 2, deriv=1, delta=dt, axis=0))

    if rates is None:
        rates = body_rates_from_rpy_rates(rpy, slope(rpy))
    return torch.cat([position, rpy, slope(position), rates], -1)


def filled(values: Tensor) -> Tensor:
    """Gaps (NaN) of a record (num_samples, width) bridged by straight lines."""
    out = values.numpy().copy()
    place = np.arange(len(out))
    for column in out.T:
        good = np.isfinite(column)
        if not good.any():
            raise ValueError("a channel of the flight has no readings at all; leave it out")
        column[~good] = np.interp(place[~good], place[good], column[good])
    return torch.from_numpy(out)


@dataclass(frozen=True, eq=False)
class Shooting:
    """Windows of one run, and how their initial states follow from what was measured.

    An initial state is that of 12 and, for the first window, the thrusts that were commanded before
    the record starts: a lag or a dead time brings them into it. The departures d from the first
    guess minimise |W (measured - predicted(d))|^2 + |d / spread|^2 by Gauss-Newton with tangents
    prepared once; they are then a smooth function of all other parameters. The prediction is the
    profile over d: misfit that an initial state can explain is no evidence for anything.

    Attributes:
        start: First guess, (num_windows, 12 + n_rotors).
        measured: (num_windows, length, num_channels), zero where nothing was recorded.
        tangent: d predicted / d start, (num_windows, length * num_channels, 12 + n_rotors).
        gain: Misfit to states, (num_windows, 12 + n_rotors, length * num_channels).
    """

    start: Tensor
    measured: Tensor
    tangent: Tensor
    gain: Tensor

    @classmethod
    def prepare(
        cls, predict: Callable[[Tensor], Tensor], start: Tensor, measured: Tensor, sd: Tensor
    ) -> Shooting:
        """Tangents by central differences.

        Args:
            predict: Starts (many, num_windows, 12 + n_rotors) -> channels (many, num_windows,
                length, num_channels).
            start: First guess, (num_windows, 12 + n_rotors).
            measured: (num_windows, length, num_channels), NaN where nothing was recorded.
            sd: Noise of the channels, (num_channels,).
        """
        windows, length, channels = measured.shape
        spread = start.new_tensor(
            [s for s in _SPREAD for _ in range(3)] + [_PAST_SPREAD] * (start.shape[1] - RIGID)
        )
        nudges = torch.diag(_NUDGE * spread)
        moved = torch.stack([start + s * n for n in nudges for s in (1.0, -1.0)])
        with torch.no_grad():
            there = predict(moved).reshape(len(spread), 2, windows, length * channels)
        tangent = (there[:, 0] - there[:, 1]) / (2.0 * _NUDGE * spread[:, None, None])
        tangent = tangent.permute(1, 2, 0).contiguous()
        weight = (torch.isfinite(measured) / sd**2).reshape(windows, -1, 1)
        normal = tangent.mT @ (weight * tangent) + torch.diag(spread**-2)
        gain = torch.linalg.solve(normal, (weight * tangent).mT)
        return cls(start, measured.nan_to_num(0.0), tangent, gain)

    def profile(self, predict: Callable[[Tensor], Tensor]) -> Tensor:
        """Predictions with the best initial states, (many, num_windows * length, num_channels).

        Args:
            predict: Starts (many or 1, num_windows, 12 + n_rotors) -> channels (many, num_windows,
                length, num_channels).
        """
        here, better, change = self._corrected(predict)
        here = here + self.tangent @ (better - change)
        return here.permute(2, 0, 1).reshape(here.shape[-1], -1, self.measured.shape[-1])

    def best(self, predict: Callable[[Tensor], Tensor]) -> Tensor:
        """The best initial states of one point, (num_windows, 12 + n_rotors)."""
        _, better, _ = self._corrected(predict)
        return self.start + better[..., 0]

    def _corrected(self, predict: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Predictions (num_windows, length * num_channels, many), and the next and last changes."""
        windows = len(self.start)
        measured = self.measured.reshape(windows, -1, 1)
        change = self.start[..., None] * 0.0
        for _ in range(_CORRECTIONS):
            here = predict(self.start + change.permute(2, 0, 1)).flatten(2).permute(1, 2, 0)
            last, change = change, self.gain @ (measured - here + self.tangent @ change)
        return here, change, last
