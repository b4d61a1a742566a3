"""Multiple shooting: a flight cut into windows whose initial states are fitted away.

The state of 12 here: position, roll-pitch-yaw, velocity (world), body rates, world NED.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from diffsim.copter import FlightState
from diffsim.core.errors import ConvergenceError
from diffsim.core.memo import Memo, memo_field
from diffsim.core.rotation import body_rates_from_rpy_rates, quaternion_from_rpy
from diffsim.systems.multicopter.secants import NUDGE, Secants

RIGID = 12  # entries of the rigid body's state; thrusts held before the record follow
# What is known of an initial state beyond its first guess: hardly anything.
SPREAD = (0.3, 0.2, 1.0, 1.0)  # [m, rad, m/s, rad/s]
PAST_SPREAD = 2.0  # of the thrusts before the record [N]
_SMOOTH_S = 0.15  # over which position is differentiated
MAX_STEPS = 12
_LEAST_SHARE = 1e-3  # of a step
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
    from scipy.signal import savgol_filter

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
    """

    guess: Tensor  # initial states estimated from the record, (num_windows, 12 + n_rotors)
    measured: Tensor  # (num_windows, length, num_channels), NaN where nothing was recorded
    sd: Tensor  # noise of the channels, (num_channels,)
    # recorded acceleration of the vehicle, (num_samples, 3), NED [m/s^2]
    acceleration: Tensor = field(default_factory=lambda: torch.zeros(1, 3, dtype=torch.float64))
    # recorded states of 12 at every sample, (num_samples, 12)
    states: Tensor = field(default_factory=lambda: torch.zeros(1, RIGID, dtype=torch.float64))
    # samples that the windows start from, (num_windows,)
    rows: Tensor = field(default_factory=lambda: torch.zeros(1, dtype=torch.long))
    # of position [m], angles [rad], velocity [m/s] and body rates [rad/s] about the guess
    rigid_spread: tuple[float, float, float, float] = SPREAD
    past_spread: float = PAST_SPREAD  # of the thrusts before the record [N]
    # which of these thrusts stay as they are in the guess, (n_rotors,) bool; none if left out
    held: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.bool))
    is_at_zero: bool = True  # whether those are held because they are zero, and may rise
    # projector onto thrusts that leave force and torque on the vehicle as they are, (n_rotors,
    # n_rotors); none if left out. No record shows them, and squares of them bend the way of every
    # search, so that they are small beforehand.
    idle: Tensor | None = None
    # states where searches start, (num_windows, 12 + n_rotors): the best ones of one model, the
    # same for all, so that none depends on another. None: the guess.
    start: Tensor | None = None
    # what searches found at the last points of the parameters
    known: Memo[FlightShooting] = memo_field(2)  # a step's end, and its start where it is not taken

    def __post_init__(self) -> None:
        if not len(self.held):
            none = torch.zeros(self.guess.shape[1] - RIGID, dtype=torch.bool)
            object.__setattr__(self, "held", none)

    @property
    def spread(self) -> Tensor:
        """Spread of the initial states about the guess, (12 + n_rotors,)."""
        rigid = [s for s in self.rigid_spread for _ in range(3)]
        return self.guess.new_tensor(rigid + [self.past_spread] * (self.guess.shape[1] - RIGID))

    @property
    def precision(self) -> Tensor:
        """Of the initial states about the guess, (12 + n_rotors, 12 + n_rotors)."""
        precision = torch.diag(self.spread**-2)
        if self.idle is not None:
            # of the spread, where thrusts only work against each other
            precision[RIGID:, RIGID:] += self.idle / (1e-2 * self.past_spread) ** 2
        return precision

    def find_starts(
        self, predict: Predict, max_steps: int = MAX_STEPS, near: Tensor | None = None
    ) -> FlightShooting:
        """The best initial states for one model, by Gauss-Newton with new tangents at every step.

        No rotor pulls backwards before the record: a thrust that wants below zero is zero, and the
        rest is best beside it. Such a bound is active in the whole neighborhood of a model, so that
        its predictions have the slopes that the fit reports.

        Args:
            predict: Starts (1 + 2 (12 + n_rotors), num_windows, 12 + n_rotors) -> channels of the
                same leading axes, (..., length, num_channels).
            max_steps: Number of full steps; fewer ask for a model that is nearer to the record, and
                are Gauss-Newton's own.
            near: States where the search starts; None: ``start``.

        Raises:
            ConvergenceError: the model is too far from the record for windows of this length.
        """
        with torch.no_grad():
            if not bool(torch.isfinite(self.measured).any()):
                return FlightShooting.unfitted(self, predict)
            starts = [(self, self.guess)]
            near = self.start if near is None else near
            if near is not None:
                starts.insert(0, self._hold_at_zero(near, near[0, RIGID:] == 0.0))
            settled = None
            for windows, states in starts:
                let_go = torch.zeros_like(self.held)
                while True:
                    shooting, size, states = windows._take_bounded_steps(predict, states, max_steps)
                    if size >= _SETTLED:
                        break
                    wanted = shooting.windows._wants_thrust(predict, states)
                    if not wanted.any():
                        return shooting
                    if not (wanted & ~let_go).any():  # it came back to zero, and would again
                        settled = settled or shooting
                        break
                    let_go = let_go | wanted
                    windows = self._hold_at_zero(self.guess, shooting.windows.held & ~wanted)[0]
            if settled is not None:
                return settled
            if max_steps >= MAX_STEPS:
                shooting, size = self._creep(predict, starts[0][1] - self.guess)
                if size < _LINEAR:
                    return shooting
        raise ConvergenceError(
            f"initial states of a flight still change by {size:.1e} of their spread after "
            f"{max_steps} steps; shorten the windows or reduce the effects' sizes",
            residual_norm=size,
            tolerance=_SETTLED,
            num_iters=max_steps,
        )

    def _take_bounded_steps(
        self, predict: Predict, states: Tensor, max_steps: int
    ) -> tuple[FlightShooting, float, Tensor]:
        """Steps with new tangents each, as long as ``Secants`` says. A thrust that a step takes
        below zero is held at zero from there on: without a slope it would come back, and go again.

        Returns:
            Tangents at the last states, the step that was wanted there over the spread, the states.
        """
        windows, secants, last = self, Secants.none(len(self.guess), self.spread), None
        for _ in range(max_steps):
            change = states - windows.guess
            shooting = windows._find_tangents(predict, change)
            step = shooting.step
            if last is not None:
                secants = secants.learned(change - last[0], last[1], step)
            size = windows._measure_step(step)
            if size < _SETTLED:
                break
            last = change, step
            if max_steps >= MAX_STEPS:
                step = windows._shorten_step(predict, change, secants.ahead(step))
            else:
                step = step / max(1.0, size)
            states = states + step
            below = states[0, RIGID:] < 0.0
            if below.any():
                windows, states = windows._hold_at_zero(states, below)
                secants, last = Secants.none(len(self.guess), self.spread), None
        return shooting, size, states

    def _measure_step(self, step: Tensor) -> float:
        """Largest entry of a step over its spread."""
        return float((step / self.spread).abs().max())

    def _hold_at_zero(self, states: Tensor, zero: Tensor) -> tuple[Windows, Tensor]:
        """The same windows with some thrusts before the record held at zero, and states there."""
        if not zero.any():
            return self, states
        held, guess, states = self.held | zero, self.guess.clone(), states.clone()
        guess[0, RIGID:][held] = 0.0
        states[0, RIGID:][held] = 0.0
        return replace(self, guess=guess, held=held), states

    def with_thrusts_held(self) -> Windows:
        """The same windows with the thrusts before the record as guessed."""
        return replace(self, held=torch.ones_like(self.held), is_at_zero=False)

    def _shorten_step(self, predict: Predict, change: Tensor, step: Tensor) -> Tensor:
        """A step as long as it may be: beyond the spread only in windows that it makes better."""
        sizes = (step / self.spread).abs().amax(1)
        if float(sizes.max()) <= 1.0:
            return step
        better = self._costs(predict, change + step) < self._costs(predict, change)
        return step / torch.where(better, 1.0, sizes.clamp(min=1.0))[:, None]

    def _wants_thrust(self, predict: Predict, states: Tensor) -> Tensor:
        """Which rotors that are held at zero would be better with a little thrust, (n_rotors,)."""
        rotors = torch.nonzero(self.held & self.is_at_zero)[:, 0]
        if not len(rotors):
            return torch.zeros_like(self.held)
        tried = states.repeat(1 + len(rotors), 1, 1)
        tried[1 + torch.arange(len(rotors)), 0, RIGID + rotors] += NUDGE * self.past_spread
        off = (predict(tried)[:, 0] - self.measured[0]) / self.sd
        cost = off.nan_to_num(0.0).square().flatten(1).sum(1)
        return torch.zeros_like(self.held).index_put((rotors,), cost[1:] < cost[0])

    def _creep(self, predict: Predict, change: Tensor) -> tuple[FlightShooting, float]:
        """Steps that are halved until the fit is better; slower, and sure to go down.

        Where that has no end the states lie on a kink: a rotor whose thrust before the record wants
        to be below zero. It is held there, the rest is settled.

        Returns:
            Tangents at the best states found, and the step that was wanted there, over the spread.
        """
        for _ in range(40):
            shooting = self._find_tangents(predict, change)
            size = self._measure_step(step := shooting.step)
            if size < _SETTLED:
                break
            here, share = self._costs(predict, change).sum(), 1.0 / max(1.0, size)
            while share > _LEAST_SHARE:
                if self._costs(predict, change + share * step).sum() <= here:
                    break
                share *= 0.5
            if share <= _LEAST_SHARE:
                break
            change = change + share * step
        states = self.guess + change
        below = ((states < 0.0) | (states + step < 0.0))[0, RIGID:] & ~self.held
        if below.any():
            windows, states = self._hold_at_zero(states, below)
        elif size < _LINEAR or self.held.all():
            return shooting, size
        else:  # another kink: thrusts before the record stay where they are
            guess = self.guess.clone()
            guess[0, RIGID:] = states[0, RIGID:]
            windows = replace(self, guess=guess).with_thrusts_held()
        return windows.find_starts(predict, near=states), 0.0

    def _costs(self, predict: Predict, change: Tensor) -> Tensor:
        """Misfit and departure from the guess over their spreads, squared, (num_windows,); each
        change is flown alone: forces settle to less than a small step gains, not to nothing."""
        off = (predict((self.guess + change)[None])[0] - self.measured) / self.sd
        off = off.where(torch.isfinite(self.measured), 0.0)
        return off.square().sum((1, 2)) + (change @ self.precision * change).sum(1)

    def _find_tangents(self, predict: Predict, change: Tensor) -> FlightShooting:
        """Tangents by central differences at changes from the guess, (num_windows, m)."""
        windows, length, channels = self.measured.shape
        spread = self.spread
        nudges = torch.diag(NUDGE * spread)
        offsets = torch.stack([nudges, -nudges], 1).flatten(0, 1)
        moved = self.guess + change + torch.cat([torch.zeros_like(nudges[:1]), offsets])[:, None]
        there = predict(moved).reshape(-1, windows, length * channels)
        tangent = (there[1::2] - there[2::2]) / (2.0 * NUDGE * spread[:, None, None])
        tangent = tangent.permute(1, 2, 0).contiguous()
        # thrusts before the record are those of the first window: what they leave of a slow lag in
        # the others is no work of the others' own
        tangent[1:, :, RIGID:] = 0.0
        tangent[:, :, RIGID:] *= ~self.held
        weight = (torch.isfinite(self.measured) / self.sd**2).reshape(windows, -1, 1)
        weighted = weight * tangent
        normal = tangent.mT @ weighted + self.precision
        return FlightShooting(
            self,
            self.measured.nan_to_num(0.0).reshape(windows, -1, 1),
            change[..., None],
            tangent,
            torch.linalg.solve(normal, weighted.mT),
            there[0][..., None],
        )


@dataclass(frozen=True, eq=False)
class FlightShooting:
    """Linear map from all other parameters to the best initial states of one run.

    Departures d from the guess minimize |W (measured - predicted(d))|^2 + |d / spread|^2, here by
    Gauss-Newton with the tangents of one model: the prediction is the profile over d. Misfit that
    an initial state can explain is no evidence for anything.
    """

    windows: Windows  # record of the run, cut into windows
    measured: Tensor  # (num_windows, length * num_channels, 1), zero where nothing was recorded
    change: Tensor  # d of that model, (num_windows, 12 + n_rotors, 1)
    tangent: Tensor  # d predicted / d start, (num_windows, length * num_channels, 12 + n_rotors)
    gain: Tensor  # misfit to states, (num_windows, 12 + n_rotors, length * num_channels)
    here: Tensor  # prediction of that model at d, (num_windows, length * num_channels, 1)

    @classmethod
    def unfitted(cls, windows: Windows, predict: Predict) -> FlightShooting:
        """Of windows without readings: they start as guessed, whatever the model.

        Args:
            windows: Windows of a run that was never recorded.
            predict: As of ``Windows.find_starts``.
        """
        here = predict(windows.guess[None])[0].flatten(1)[..., None]
        change = torch.zeros_like(windows.guess)[..., None]
        still = here.new_zeros(*here.shape[:2], change.shape[1])
        return cls(windows, torch.zeros_like(here), change, still, still.mT, here)

    @property
    def step(self) -> Tensor:
        """From d to the best one by these tangents, (num_windows, 12 + n_rotors)."""
        return (self.better(self.here, self.change) - self.change)[..., 0]

    @property
    def states(self) -> Tensor:
        """Initial states of that model, (num_windows, 12 + n_rotors)."""
        return self.windows.guess + self.change[..., 0]

    def at_own_point(self) -> Tensor:
        """Prediction of the model of the tangents, (num_windows * length, num_channels)."""
        best = self.better(self.here, self.change)
        return (self.here + self.tangent @ (best - self.change)).reshape(-1, len(self.windows.sd))

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
