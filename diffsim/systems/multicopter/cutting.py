"""Records of flights cut into windows, whose length may follow from the model.

Before, records are brought to an even clock: flights are simulated from sample to sample.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY, Fleet
from diffsim.core.arrays import Array, Mask
from diffsim.core.errors import DiffsimError
from diffsim.core.memo import Memo
from diffsim.core.rotation import matrix_from_quaternion, matrix_from_rpy, rpy_from_matrix
from diffsim.data.signal import GAP
from diffsim.data.study import Run, Study
from diffsim.systems.multicopter.frames import SENSORS, RecordingFrames
from diffsim.systems.multicopter.scene import CopterScene
from diffsim.systems.multicopter.shooting import (
    PAST_SPREAD,
    SPREAD,
    Windows,
    filled,
    guess_states,
    slope,
)

_DOWN = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)


def states_of(groups: Mapping[str, Tensor], frames: RecordingFrames, dt: float) -> Tensor:
    """States of 12 at every sample, (num_samples, 12), in the model's frames.

    Velocity that was not recorded is the slope of the position, body rates are those of the
    attitude. Roll and pitch that were not recorded follow from the direction of the thrust: that of
    the acceleration less gravity.

    Args:
        groups: Readings by group, keys of ``SENSORS``, (num_samples, 3 or 4) each in the
            recording's frames; columns without any reading are NaN, gaps are filled.
        dt: Time between two samples [s].
    """
    position, velocity = _find_path(groups, frames, dt)
    rates = groups.get("body_rates")
    if rates is not None:
        rates = None if bool(rates.isnan().any()) else frames.in_body(rates)
    rpy = _find_attitude(groups, frames, velocity, dt)
    states = guess_states(position, rpy, rates, dt)
    states[:, 6:9] = velocity
    return states


def acceleration_of(
    groups: Mapping[str, Tensor], frames: RecordingFrames, states: Tensor, dt: float
) -> Tensor:
    """Acceleration of the vehicle at every sample, (num_samples, 3), world frame of the model.

    By the accelerometer, if there is one, else the slope of the velocity.

    Args:
        groups: Readings by group, as of ``states_of``.
        states: States of 12 at every sample, (num_samples, 12).
        dt: Time between two samples [s].
    """
    specific = groups.get("accelerometer")
    if specific is not None and not bool(specific.isnan().any()):
        rotation = matrix_from_rpy(states[:, 3:6])
        found = (rotation * frames.in_body(specific)[:, None]).sum(-1)
    else:
        found = _find_thrust_acceleration(groups, frames, states[:, 6:9], dt)
    return found + _DOWN


def _find_path(
    groups: Mapping[str, Tensor], frames: RecordingFrames, dt: float
) -> tuple[Tensor, Tensor]:
    """Position and velocity, (num_samples, 3) each."""
    place, speed = groups.get("position"), groups.get("velocity")
    if place is None:
        if speed is None:
            raise ValueError("flights need a recorded position or velocity, got neither")
        speed = frames.in_world(speed.nan_to_num(0.0))
        return dt * speed.cumsum(0), speed
    place = place.nan_to_num(0.0)
    shown = slope(place, dt)
    if speed is not None:
        shown = torch.where(speed.isnan(), shown, speed)
    return frames.in_world(place), frames.in_world(shown)


def _find_attitude(
    groups: Mapping[str, Tensor], frames: RecordingFrames, velocity: Tensor, dt: float
) -> Tensor:
    """Roll, pitch and yaw without jumps, (num_samples, 3)."""
    quaternion, rpy = groups.get("quaternion"), groups.get("attitude")
    if quaternion is not None and not bool(quaternion.isnan().any()):
        unit = quaternion / quaternion.norm(dim=-1, keepdim=True).clamp(min=1e-12)
        rotation = frames.rotation(matrix_from_quaternion(unit))
    elif rpy is not None and not bool(rpy.isnan().any()):
        if frames == RecordingFrames():
            return rpy
        rotation = frames.rotation(matrix_from_rpy(rpy))
    else:
        rotation = _find_rotation_by_thrust(
            _find_thrust_acceleration(groups, frames, velocity, dt), rpy, frames
        )
    angles = rpy_from_matrix(rotation).numpy()
    return torch.from_numpy(np.unwrap(angles, axis=0))


def _find_thrust_acceleration(
    groups: Mapping[str, Tensor], frames: RecordingFrames, velocity: Tensor, dt: float
) -> Tensor:
    """Force over mass besides gravity, world frame of the model, (num_samples, 3) [m/s^2]."""
    for name, gravity in (("acceleration", _DOWN), ("specific_force_in_world", 0.0 * _DOWN)):
        given = groups.get(name)
        if given is not None and not bool(given.isnan().any()):
            return frames.in_world(given) - gravity
    return slope(velocity, dt) - _DOWN


def _find_rotation_by_thrust(thrust: Tensor, rpy: Tensor | None, frames: RecordingFrames) -> Tensor:
    """World from body of the model, (num_samples, 3, 3): what was recorded of roll, pitch and yaw,
    the rest by the direction of the thrust."""
    known = torch.full_like(thrust, torch.nan) if rpy is None else rpy
    heading = torch.zeros_like(thrust)
    heading[:, 2] = known[:, 2].nan_to_num(0.0)
    yaw = rpy_from_matrix(frames.rotation(matrix_from_rpy(heading)))[:, 2]
    x, y, z = (-thrust / thrust.norm(dim=-1, keepdim=True).clamp(min=1e-6)).unbind(-1)
    ahead, right = yaw.cos() * x + yaw.sin() * y, yaw.cos() * y - yaw.sin() * x
    # the body's z axis at this heading is (sin p cos r, -sin r, cos p cos r)
    angles = torch.stack([-right.clamp(-1.0, 1.0).asin(), torch.atan2(ahead, z), yaw], -1)
    shown = rpy_from_matrix(frames.rotation(matrix_from_rpy(angles)))
    shown = torch.where(known.isnan(), shown, known)
    return frames.rotation(matrix_from_rpy(shown))


LONGEST = "longest_window_s"  # its place among the facts of a model
LONGEST_S = 1.0  # of a window whose length is left to the model
MIN_WINDOW_SAMPLES = 5  # samples of a window
_UNEVEN = 1e-3  # of the mean step: below it a clock is even


def spacing(run: Run) -> float:
    """Time between two samples [s].

    Raises:
        ValueError: the samples are not evenly spaced.
    """
    steps = np.diff(run.time_s)
    dt = float(steps.mean())
    if np.abs(steps - dt).max() > _UNEVEN * dt:
        raise ValueError(
            f"run {run.name}: flights need evenly spaced samples, got steps of {steps.min():.4g} "
            f"to {steps.max():.4g} s; resample the record"
        )
    return dt


def is_planned(run: Run) -> bool:
    """Whether a run was never recorded: at most its first readings are given, where it starts."""
    return not np.isfinite(run.measured[1:]).any()


def thrusts_before(run: Run, asked: Tensor) -> Tensor:
    """Guess of the thrusts before a record, (1, n_rotors) [N].

    Args:
        run: Recorded run, or a planned one, whose first command has been held.
        asked: Thrusts that its commands ask for, (1, num_samples, n_rotors) [N].
    """
    return (asked[:, 0] if is_planned(run) else asked.mean(1)).detach()


def idle_thrusts(vehicle: Fleet) -> Tensor | None:
    """Projector onto thrusts that leave force and torque as they are, (n_rotors, n_rotors).

    Returns:
        None where there are none: up to four rotors, as a rule.
    """
    # as accelerations: torques of a small vehicle are tiny numbers, what they do is not
    along = vehicle.directions[0].mT / vehicle.mass[0]
    about = torch.linalg.solve(vehicle.inertia[0], vehicle.torque_matrix[0])
    moves = torch.cat([along, about])
    _, size, ways = torch.linalg.svd(moves, full_matrices=False)
    # of the strongest way to move the vehicle: weaker ones are none
    seen = ways[size > 1e-3 * size.max()]
    if len(seen) == vehicle.num_rotors:
        return None
    return torch.eye(vehicle.num_rotors, dtype=torch.float64) - seen.mT @ seen


class RecordedFlights(NamedTuple):
    """States of 12 at every sample, (num_samples, 12), and accelerations, (num_samples, 3), NED."""

    states: Tensor
    acceleration: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class Cutter:
    """How the records of a study are cut."""

    sensors: tuple[str, ...]  # groups of readings, keys of ``SENSORS``
    sd: Tensor  # noise of the channels, (num_channels,)
    # length of a window [s]; None: as long as the model allows, up to ``longest_s``
    window_s: float | None
    # which reading each channel is, counted over the groups; None: all, in order
    columns: tuple[int, ...] | None = None
    # frames that the record is written in
    frames: RecordingFrames = field(default_factory=RecordingFrames)
    # rigid_spread, past_spread: of the initial states, as :class:`Windows` has them
    rigid_spread: tuple[float, float, float, float] = SPREAD
    past_spread: float = PAST_SPREAD
    longest_s: float = LONGEST_S  # longest window whose length is left to the model [s]

    def cut(
        self,
        run: Run,
        past: Tensor,
        scene: Callable[[Windows], CopterScene],
        vehicle: Fleet | None = None,
    ) -> Windows:
        """Windows of a run; searches start from the states of the model with its prior.

        Args:
            past: Guess of the thrusts before the record, (1, n_rotors) [N].
            scene: Function of windows: the run in them, as the model with its prior flies it.
            vehicle: The one that flies, where more rotors may pull than move it apart.
        """
        idle = None if vehicle is None else idle_thrusts(vehicle)
        dt = spacing(run)
        if is_planned(run):
            return self._cut_windows(run, past, len(run.time_s), idle)
        length = min(
            max(MIN_WINDOW_SAMPLES, round((self.window_s or self.longest_s) / dt)), len(run.time_s)
        )
        windows = self._cut_windows(run, past, length, idle)
        while self.window_s is None and length > MIN_WINDOW_SAMPLES:
            try:
                # steps in which initial states settle where windows are not too long
                scene(windows.with_thrusts_held()).find_starts(6)
                break
            except DiffsimError:  # the model leaves the record within a window
                length = max(MIN_WINDOW_SAMPLES, length // 2)
                windows = self._cut_windows(run, past, length, idle)
        try:  # thrusts before the record may be at a bound of this model, and not of another
            found = scene(windows.with_thrusts_held()).find_starts()
        except DiffsimError:
            return windows
        return replace(windows, start=found.states)

    def _cut_windows(self, run: Run, past: Tensor, length: int, idle: Tensor | None) -> Windows:
        """Start one sample early, for the accelerometer shows the mean over the step before."""
        measured = torch.as_tensor(np.asarray(run.measured), dtype=torch.float64)
        if measured.shape[1] != len(self.sd):
            raise ValueError(
                f"run {run.name} has {measured.shape[1]} channels, the sensors "
                f"{list(self.sensors)} need {len(self.sd)}"
            )
        windows = -(-len(measured) // length)
        record = torch.full((windows * length, len(self.sd)), np.nan, dtype=torch.float64)
        if not is_planned(run):
            record[: len(measured)] = measured
        motion = self.record(run)
        states = motion.states
        before = (torch.arange(windows) * length - 1).clamp(min=0)
        return Windows(
            guess=torch.cat([states[before], past.expand(windows, -1)], 1),
            measured=record.reshape(windows, length, -1),
            sd=self.sd,
            acceleration=motion.acceleration,
            states=states,
            rows=before,
            rigid_spread=self.rigid_spread,
            past_spread=self.past_spread,
            idle=idle,
        )

    def kept(self, run: Run, known: Memo[Windows], cut: Callable[[], Windows]) -> Windows:
        """Windows of a run; those of a planned one are cut anew, as its commands change."""
        return cut() if is_planned(run) else known(run, cut)

    def record(self, run: Run) -> RecordedFlights:
        """The motion that a run's record shows by itself; a planned run rests where it starts."""
        measured = torch.as_tensor(np.asarray(run.measured), dtype=torch.float64)
        whole = measured[:1].expand_as(measured) if is_planned(run) else filled(measured)
        dt, groups = spacing(run), self._group_readings(whole)
        states = states_of(groups, self.frames, dt)
        return RecordedFlights(states, acceleration_of(groups, self.frames, states, dt))

    def _group_readings(self, whole: Tensor) -> dict[str, Tensor]:
        """Readings by group; NaN in columns that were not recorded."""
        widths = [len(SENSORS[g]) for g in self.sensors]
        if self.columns is not None:
            readings = whole.new_full((len(whole), sum(widths)), torch.nan)
            readings[:, list(self.columns)] = whole
            whole = readings
        return dict(zip(self.sensors, whole.split(widths, 1), strict=True))


def evenly_sampled(study: Study, rate_hz: float | None, means: Sequence[bool]) -> Study:
    """A study whose runs have evenly spaced samples.

    Between samples values follow straight lines; in gaps of the clock nothing was recorded.
    Commands are means over the step that follows a sample.

    Args:
        rate_hz: Samples per second; None: as recorded, and runs that are even stay as they are.
        means: Which channels are means over the step before: accelerations are.
    """
    runs = tuple(_make_even(run, rate_hz, np.array(means)) for run in study.runs)
    if all(a is b for a, b in zip(runs, study.runs, strict=True)):
        return study
    return replace(study, runs=runs)


def _make_even(run: Run, rate_hz: float | None, means: Mask) -> Run:
    steps = np.diff(run.time_s)
    usual = float(np.median(steps))
    mean = float(steps.mean())
    is_even = bool(np.abs(steps - mean).max() <= _UNEVEN * mean)
    if is_even and (rate_hz is None or abs(rate_hz * mean - 1.0) < _UNEVEN):
        return run
    dt = usual if rate_hz is None else 1.0 / rate_hz
    count = int((run.time_s[-1] - run.time_s[0]) / dt + 1e-6) + 1
    time = run.time_s[0] + dt * np.arange(count)
    limit = GAP * max(dt, usual)
    columns = [
        _resample_channel(run.time_s, values, time, dt, limit, is_mean=bool(m))
        for values, m in zip(run.measured.T, means, strict=True)
    ]
    command = {
        name: _average_held(
            run.time_s, np.asarray(values, dtype=np.float64), time, time + dt, is_before=False
        )
        for name, values in run.command.items()
    }
    beside = {name: np.interp(time, run.time_s, values) for name, values in run.columns.items()}
    kept = replace(run, raw={})  # whose rows are those of the file
    measured = np.stack(columns, 1)
    return replace(kept, time_s=time, measured=measured, command=command, columns=beside)


def _resample_channel(
    old: Array, values: Array, time: Array, dt: float, limit: float, *, is_mean: bool
) -> Array:
    """One channel at new times; NaN where no reading is near."""
    good = np.isfinite(values)
    if not good.any():
        return np.full(len(time), np.nan)
    at, there = old[good], values[good]
    out = (
        _average_held(at, there, time - dt, time, is_before=True)
        if is_mean
        else np.interp(time, at, there)
    )
    after = np.searchsorted(at, time).clip(1, len(at) - 1)
    inside = at[after] - at[after - 1] > limit
    near = np.minimum(np.abs(time - at[after]), np.abs(time - at[after - 1])) < 0.5 * dt
    return np.where(inside & ~near, np.nan, out)


def _average_held(old: Array, values: Array, start: Array, end: Array, *, is_before: bool) -> Array:
    """Means over intervals of what is held between samples; ends held.

    Args:
        old: Times of the samples, (num_samples,) [s].
        values: Held until the next sample, or since the one before where ``is_before``.
        start, end: Ends of the intervals [s].
        is_before: Whether a value holds over the step before its sample.
    """
    held = values[1:] if is_before else values[:-1]
    total = np.concatenate([[0.0], np.cumsum(held * np.diff(old))])

    def integral(t: Array) -> Array:
        found: Array = np.interp(t, old, total)
        beyond = np.where(t < old[0], values[0], values[-1]) * (t - np.clip(t, old[0], old[-1]))
        return found + beyond

    means: Array = (integral(end) - integral(start)) / (end - start)
    return means
