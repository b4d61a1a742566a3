"""Multiple shooting: a flight cut into windows whose initial states are fitted away.

The state of 12 here: position, roll-pitch-yaw, velocity (world), body rates, world NED.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.signal import savgol_filter
from torch import Tensor

from diffsim.copter import FlightState
from diffsim.core.errors import ConvergenceError
from diffsim.core.rotation import body_rates_from_rpy_rates, quaternion_from_rpy

RIGID = 12  # entries of the rigid body's state; thrusts held before the record follow
# What is known of an initial state beyond its first guess: hardly anything.
SPREAD = (0.3, 0.2, 1.0, 1.0)  # [m, rad, m/s, rad/s]
PAST_SPREAD = 2.0  # of the thrusts before the record [N]
_NUDGE = 1e-4  # of the spread
_SMOOTH_S = 0.15  # over which position is differentiated
MAX_STEPS = 12
_MAX_CREEPING = 40
_LEAST_SHARE = 1e-3  # of a step
_HELD = 1e-8  # of the spread of thrusts before the record, where they stay at a kink
_SETTLED = 3e-5  # step of an initial state over its spread
_LINEAR = 1e-2  # likewise, where the tangents suffice without another flight


Predict = Callable[[Tensor], Tensor]


def flight_state(x12: Tensor) -> FlightState:
    """States of 12, (batch, 12), as starts of flights."""
    position, rpy, velocity, rates = (part.contiguous() for part in x12.split(3, -1))
    return FlightState(position, quaternion_from_rpy(rpy), velocity, rates)


def guess_states(position: Tensor, rpy: Tensor, rates: Tensor | None, dt: float) -> Tensor:
    """States of 12 at every sample, from noisy records (num_samples, 3) each.

    Velocity is the slope of a quadratic fitted over 0.15 s; body rates, if there is no gyro, the
    same of roll, pitch and yaw.
    """
    if rates is None:
        rates = body_rates_from_rpy_rates(rpy, slope(rpy, dt))
    return torch.cat([position, rpy, slope(position, dt), rates], -1)


def slope(values: Tensor, dt: float) -> Tensor:
    """Change per second of noisy records (num_samples, width), by quadratics over 0.15 s."""
    count = values.shape[0]
    width = min(max(5, 2 * round(0.5 * _SMOOTH_S / dt) + 1), (count - 1) // 2 * 2 + 1)
    if width < 5:
        raise ValueError(f"a flight needs five samples or more, got {count}")
    return torch.from_numpy(savgol_filter(values.numpy(), width, 2, deriv=1, delta=dt, axis=0))


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
class Windows:
    """Record of one run, cut into windows.

    An initial state is that of 12 and, for the first window, the thrusts that were commanded before
    the record starts: a lag or a dead time brings them into it.

    Attributes:
        guess: Initial states estimated from the record, (num_windows, 12 + n_rotors).
        measured: (num_windows, length, num_channels), NaN where nothing was recorded.
        sd: Noise of the channels, (num_channels,).
        latest: The best states of the last search (or none): where the next search starts.
        acceleration: Recorded acceleration of the vehicle, (num_samples, 3), NED [m/s^2].
        rigid_spread: Of position [m], angles [rad], velocity [m/s] and body rates [rad/s] about
            the guess.
        past_spread: Of the thrusts before the record [N].
        past_is_held: Whether these thrusts stay where they are, at a kink.
    """

    guess: Tensor
    measured: Tensor
    sd: Tensor
    latest: list[Tensor]
    acceleration: Tensor = field(default_factory=lambda: torch.zeros(1, 3, dtype=torch.float64))
    rigid_spread: tuple[float, float, float, float] = SPREAD
    past_spread: float = PAST_SPREAD
    past_is_held: bool = False

    @property
    def spread(self) -> Tensor:
        """Spread of the initial states about the guess, (12 + n_rotors,)."""
        rigid = [s for s in self.rigid_spread for _ in range(3)]
        return self.guess.new_tensor(rigid + [self.past_spread] * (self.guess.shape[1] - RIGID))

    def settled(self, predict: Predict, max_steps: int = MAX_STEPS) -> Shooting:
        """The best initial states for one model, by Gauss-Newton with new tangents at every step.

        Args:
            predict: Starts (1 + 2 (12 + n_rotors), num_windows, 12 + n_rotors) -> channels of the
                same leading axes, (..., length, num_channels).
            max_steps: Number of full steps; fewer ask for a model that is nearer to the record.

        Raises:
            ConvergenceError: the model is too far from the record for windows of this length.
        """
        with torch.no_grad():
            for change in [*(best - self.guess for best in self.latest), 0.0 * self.guess]:
                for _ in range(max_steps):
                    shooting, step = self._step(predict, change)
                    size = float((step / self.spread).abs().max())
                    if size < _SETTLED:
                        self.latest[:] = [self.guess + change]
                        return shooting
                    change = change + step / max(1.0, size)
            if max_steps >= MAX_STEPS:
                change = self.latest[0] - self.guess if self.latest else 0.0 * self.guess
                shooting, size = self._crept(predict, change)
                if size < _LINEAR:
                    return shooting
        raise ConvergenceError(
            f"initial states of a flight still change by {size:.1e} of their spread after "
            f"{max_steps} steps; shorten the windows or reduce the effects' sizes",
            residual_norm=size,
            tolerance=_SETTLED,
            num_iters=max_steps,
        )

    def _crept(self, predict: Predict, change: Tensor) -> tuple[Shooting, float]:
        """Steps that are halved until the fit is better; slower, and sure to go down.

        Where that has no end the states lie on a kink: a rotor whose thrust before the record wants
        to be below zero. These thrusts stay there, the rest is settled.

        Returns:
            Tangents at the best states found, and the step that was wanted there, over the spread.
        """
        for _ in range(_MAX_CREEPING):
            shooting, step = self._step(predict, change)
            size = float((step / self.spread).abs().max())
            if size < _SETTLED:
                self.latest[:] = [self.guess + change]
                break
            here, share = self._cost(predict, change), 1.0 / max(1.0, size)
            while share > _LEAST_SHARE and self._cost(predict, change + share * step) > here:
                share *= 0.5
            if share <= _LEAST_SHARE:
                break
            change = change + share * step
        if size < _LINEAR:
            return shooting, size
        return self._with_past_held(predict, change) or (shooting, size)

    def _with_past_held(self, predict: Predict, change: Tensor) -> tuple[Shooting, float] | None:
        """The best of the rest where the thrusts before the record stay; None if that was tried."""
        if self.past_is_held or self.guess.shape[1] == RIGID:
            return None
        past = torch.zeros_like(change)
        past[:, RIGID:] = change[:, RIGID:]
        held = replace(
            self,
            guess=self.guess + past,
            latest=[self.guess + change],
            past_spread=_HELD * self.past_spread,
            past_is_held=True,
        )
        shooting = held.settled(predict)
        self.latest[:] = held.latest
        return shooting, 0.0

    def _cost(self, predict: Predict, change: Tensor) -> float:
        """Misfit and departure from the guess, in units of their spreads, squared."""
        off = (predict((self.guess + change)[None])[0] - self.measured) / self.sd
        return float(off.nan_to_num(0.0).square().sum() + (change / self.spread).square().sum())

    def _step(self, predict: Callable[[Tensor], Tensor], change: Tensor) -> tuple[Shooting, Tensor]:
        """Tangents by central differences, and the step to be taken, (num_windows, m)."""
        windows, length, channels = self.measured.shape
        spread = self.spread
        start = self.guess + change
        nudges = torch.diag(_NUDGE * spread)
        moved = torch.stack([start, *(start + s * n for n in nudges for s in (1.0, -1.0))])
        there = predict(moved).reshape(-1, windows, length * channels)
        tangent = (there[1::2] - there[2::2]) / (2.0 * _NUDGE * spread[:, None, None])
        tangent = tangent.permute(1, 2, 0).contiguous()
        # thrusts before the record are those of the first window: what they leave of a slow lag in
        # the others is no work of the others' own
        tangent[1:, :, RIGID:] = 0.0
        weight = (torch.isfinite(self.measured) / self.sd**2).reshape(windows, -1, 1)
        normal = tangent.mT @ (weight * tangent) + torch.diag(spread**-2)
        gain = torch.linalg.solve(normal, (weight * tangent).mT)
        measured = self.measured.nan_to_num(0.0).reshape(windows, -1, 1)
        shooting = Shooting(self, measured, change[..., None], tangent, gain)
        return shooting, (shooting.better(there[0][..., None], change[..., None]))[..., 0] - change


@dataclass(frozen=True, eq=False)
class Shooting:
    """Linear map from all other parameters to the best initial states of one run.

    Departures d from the guess minimize |W (measured - predicted(d))|^2 + |d / spread|^2, here by
    Gauss-Newton with the tangents of one model: the prediction is the profile over d. Misfit that
    an initial state can explain is no evidence for anything.

    Attributes:
        windows: Record of the run, cut into windows.
        measured: (num_windows, length * num_channels, 1), zero where nothing was recorded.
        change: d of that model, (num_windows, 12 + n_rotors, 1).
        tangent: d predicted / d start, (num_windows, length * num_channels, 12 + n_rotors).
        gain: Misfit to states, (num_windows, 12 + n_rotors, length * num_channels).
    """

    windows: Windows
    measured: Tensor
    change: Tensor
    tangent: Tensor
    gain: Tensor

    def better(self, here: Tensor, change: Tensor) -> Tensor:
        """The next d, (num_windows, 12 + n_rotors, many).

        Args:
            here: Prediction at d, (num_windows, length * num_channels, many).
            change: Change d of the initial states so far, (num_windows, 12 + n_rotors, many).
        """
        return self.gain @ (self.measured - here + self.tangent @ change)

    def profile(self, predict: Callable[[Tensor], Tensor]) -> Tensor:
        """Predictions with the best initial states, (many, num_windows * length, num_channels).

        Args:
            predict: Starts (many or 1, num_windows, 12 + n_rotors) -> channels (many, num_windows,
                length, num_channels) of models near that of the tangents.

        Raises:
            ConvergenceError: a model is too far from that of the tangents.
        """
        windows, change = self.windows, self.change
        for _ in range(MAX_STEPS):
            here = predict(windows.guess + change.permute(2, 0, 1)).flatten(2).permute(1, 2, 0)
            better = self.better(here, change)
            size = float(((better - change).detach() / windows.spread[:, None]).abs().max())
            if size < _LINEAR:
                here = here + self.tangent @ (better - change)
                return here.permute(2, 0, 1).reshape(here.shape[-1], -1, len(windows.sd))
            change = better
        raise ConvergenceError(
            f"initial states of a flight still change by {size:.1e} of their spread after "
            f"{MAX_STEPS} steps with the tangents of another point",
            residual_norm=size,
            tolerance=_LINEAR,
            num_iters=MAX_STEPS,
        )
