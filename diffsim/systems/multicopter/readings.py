"""What the sensors of a multicopter show, in the frames and columns of the recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from diffsim.causes.channel_groups import delays_of
from diffsim.causes.ports import SignalChange
from diffsim.causes.scene import Scene
from diffsim.causes.signals import Grid, SignalMap, change_rows, lagged
from diffsim.copter.vehicle.multicopter import GRAVITY, Fleet
from diffsim.core.rotation import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
    quaternion_product,
    rpy_from_matrix,
)
from diffsim.systems.multicopter.estimator import BlindEstimator
from diffsim.systems.multicopter.frames import SENSORS, RecordingFrames
from diffsim.systems.multicopter.lag import lagged_in_windows
from diffsim.systems.multicopter.motion import FlightMotion, turned, turned_back, vector_of
from diffsim.systems.multicopter.shooting import Windows

#: Numbers that are one until a cause changes them: shown over true [-].
SCALES = ("position_scale", "ground_scale", "accelerometer_scale")
_ONE = torch.ones(1, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedScene(Scene):
    """A flight as its record shows it: what sensors read, in which frames, in which windows.

    Numbers of the sensors are ``SCALES``, the vectors ``placement`` (of the captured point, in the
    body frame [m]), ``sensor_tilt`` (a small rotation of the inertial unit [rad]) and
    ``attitude_offset``, ``body_rates_offset``, ``accelerometer_offset`` (added to what these show
    [rad], [rad/s], [m/s^2]), all in the recording's frames; ``camera_delay``, the age of the
    position, velocity and attitude that are shown [s].
    """

    numbers: Mapping[str, Tensor] = field(default_factory=dict)
    windows: Windows  # the record in windows, whose initial states are fitted away
    sensors: tuple[str, ...]  # groups of channels of the record, in order; keys of ``SENSORS``
    # which reading each channel is, counted over the groups; None: all, in order
    columns: tuple[int, ...] | None = None
    # frames that the record is written in
    frames: RecordingFrames = field(default_factory=RecordingFrames)
    # errors of one that shows velocity and attitude; None: none
    estimator: BlindEstimator | None = None

    @property
    def dt(self) -> float:
        """Time between two samples [s]."""
        return float(self.grid.times[1] - self.grid.times[0])

    def number(self, name: str) -> Tensor:
        """A number as it is in this run, () or (points,)."""
        if name in SCALES and name not in self.numbers:
            return _ONE
        return super().number(name)

    def scalar(self, name: str) -> Tensor:
        """A number, (points,)."""
        return self.number(name).reshape(-1)

    def vector(self, name: str) -> Tensor:
        """Numbers along the axes of the recording, (points, 3)."""
        return vector_of(self.numbers, name)


@dataclass(frozen=True, eq=False)
class SensedRecord:
    """States of windows, (points, num_windows, length + 1, ...), the one after the last too."""

    position: Tensor
    velocity: Tensor
    rotation: Tensor
    quaternion: Tensor
    body_rates: Tensor

    def motion(self, vehicle: Fleet, thrusts: Tensor, asked: Tensor, dt: float) -> FlightMotion:
        """Motion in the middle of steps, where causes are right to second order."""
        place, velocity, rotation, rates = (
            0.5 * (value[:, :, :-1] + value[:, :, 1:])
            for value in (self.position, self.velocity, self.rotation, self.body_rates)
        )
        mean = self.velocity.diff(dim=2) / dt
        return FlightMotion(vehicle, place, velocity, rotation, rates, thrusts, asked, mean)

    def before(self, delay: Tensor, dt: float) -> SensedRecord:
        """The record a time ago: cubics between steps, parabolas before the window.

        Args:
            delay: Delay of each point, (points,) [s].
            dt: Time between two steps [s].
        """
        quaternion = _look_back(self.quaternion, delay, dt)  # integrated: no sign jumps
        quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
        return SensedRecord(
            _look_back(self.position, delay, dt),
            _look_back(self.velocity, delay, dt),
            matrix_from_quaternion(quaternion),
            quaternion,
            _look_back(self.body_rates, delay, dt),
        )


def _look_back(values: Tensor, delay: Tensor, dt: float) -> Tensor:
    """Values (points, num_windows, length + 1, width) at every step, ``delay`` earlier."""
    last = values.shape[2] - 1
    slope = torch.gradient(values, dim=2)[0]  # per step, central inside
    place = torch.arange(last + 1, dtype=values.dtype) - delay.reshape(-1, 1) / dt
    left = place.detach().floor().long().clamp(0, last - 1)

    def at(of: Tensor, index: Tensor) -> Tensor:
        points = max(len(index), len(of))
        index = index[:, None, :, None].expand(points, of.shape[1], -1, of.shape[3])
        return of.expand(points, -1, -1, -1).gather(2, index)

    s = (place - left)[:, None, :, None]
    y0, y1, d0, d1 = at(values, left), at(values, left + 1), at(slope, left), at(slope, left + 1)
    rise = y1 - y0
    bent = 2.0 * (rise - d0)  # of the parabola through both values with the slope at the first
    inside = y0 + s * (d0 + s * (3.0 * rise - 2.0 * d0 - d1 + s * (d0 + d1 - 2.0 * rise)))
    return torch.where(s < 0.0, y0 + s * (d0 + 0.5 * s * bent), inside)


@dataclass(frozen=True, eq=False)
class _ShownStates:
    """What sensors see at the end of every step, (points, num_windows, length, ...)."""

    scene: RecordedScene  # run that was flown
    record: SensedRecord  # how it was flown
    # position, velocity, rotation, quaternion: as cameras show them, late where they are
    position: Tensor
    velocity: Tensor
    rotation: Tensor
    quaternion: Tensor
    # error of the shown attitude as a quaternion, (points, num_windows, length + 1, 4); None: none
    turn: Tensor | None = None

    @classmethod
    def of(cls, scene: RecordedScene, record: SensedRecord) -> _ShownStates:
        states = record.position, record.velocity, record.rotation, record.quaternion
        shown = cls(scene, record, *(state[:, :, 1:] for state in states))
        if scene.estimator is not None:
            shown = shown._estimate(scene.estimator)
        if "camera_delay" not in scene.numbers:
            return shown
        return shown._delay(_widen(scene.scalar("camera_delay")))

    @property
    def body_rates(self) -> Tensor:
        """Angular velocity in the body frame [rad/s]."""
        return self.record.body_rates[:, :, 1:]

    @cached_property
    def acceleration(self) -> Tensor:
        """Mean over the step, gravity not counted, world frame [m/s^2]."""
        return self.record.velocity.diff(dim=2) / self.scene.dt

    @cached_property
    def halfway(self) -> Tensor:
        """World from body in the middle of the step."""
        rotation = self.record.rotation
        return 0.5 * (rotation[:, :, :-1] + rotation[:, :, 1:])

    @property
    def facing(self) -> Tensor:
        """The same as it is shown."""
        if self.turn is None:
            return self.halfway
        return matrix_from_quaternion(self.turn[:, :, :-1]) @ self.halfway

    def _estimate(self, estimator: BlindEstimator) -> _ShownStates:
        gravity = self.position.new_tensor([0.0, 0.0, GRAVITY])
        axis = self.halfway[..., 2]
        force = ((self.acceleration - gravity) * axis).sum(-1, keepdim=True) * axis
        rows, dt = self.scene.windows.rows, self.scene.dt
        error, turned = estimator.in_windows(rows, self.record.velocity, force, dt)
        turn = quaternion_from_rotation_vector(turned)
        quaternion = quaternion_product(turn[:, :, 1:], self.quaternion)
        rotation = matrix_from_quaternion(quaternion)
        velocity = self.velocity + error[:, :, 1:]
        return replace(self, velocity=velocity, rotation=rotation, quaternion=quaternion, turn=turn)

    def _delay(self, delay: Tensor) -> _ShownStates:
        """As it was a time ago, (points, 1, 1) [s]."""
        late = delay[..., None]
        position = self.position - late * (self.velocity - 0.5 * late * self.acceleration)
        velocity = self.velocity - late * self.acceleration
        back = quaternion_from_rotation_vector(-late * self.body_rates)
        quaternion = quaternion_product(self.quaternion, back)
        rotation = matrix_from_quaternion(quaternion)
        return replace(
            self, position=position, velocity=velocity, rotation=rotation, quaternion=quaternion
        )

    def in_unit(self, value: Tensor) -> Tensor:
        """A body vector in the axes of the inertial unit."""
        tilt = self.scene.frames.in_body(self.scene.vector("sensor_tilt"))
        tilt, value = torch.broadcast_tensors(_widen(tilt), value)
        return value - torch.linalg.cross(tilt, value)

    def shown_position(self) -> Tensor:
        """Place of the marker in the recording's world."""
        scene = self.scene
        marker = scene.frames.in_body(scene.vector("placement"))
        seen = self.position + turned(self.rotation, _widen(marker))
        scale = scene.scalar("position_scale")[:, None] * self._make_axis_scale()
        return scene.frames.in_world(_widen(scale) * seen)

    def _make_axis_scale(self) -> Tensor:
        """Scale of the three axes by what holds along the ground alone, (points, 3)."""
        along = self.scene.scalar("ground_scale")[:, None]
        return torch.cat([along, along, torch.ones_like(along)], -1)

    def shown_velocity(self) -> Tensor:
        """Velocity of the center of mass in the recording's world."""
        return self.scene.frames.in_world(self.velocity)

    def shown_attitude(self) -> Tensor:
        """Roll, pitch, yaw; whole turns as in the record."""
        rpy = rpy_from_matrix(self.scene.frames.rotation(self.rotation))
        rpy = rpy + _widen(self.scene.vector("attitude_offset"))
        measured = self._pick_measured("attitude")
        return rpy + math.tau * ((measured - rpy) / math.tau).nan_to_num(0.0).round().detach()

    def shown_quaternion(self) -> Tensor:
        """Quaternion of the recorded sign and length: neither says anything of the attitude."""
        back = quaternion_from_rotation_vector(_widen(self.scene.vector("attitude_offset")))
        shown = quaternion_product(self.scene.frames.quaternion(self.quaternion), back)
        measured = self._pick_measured("quaternion")
        sign = (measured * shown.detach()).nan_to_num(0.0).sum(-1, keepdim=True)
        length = measured.norm(dim=-1, keepdim=True)
        length = torch.where(torch.isfinite(length) & (length > 0.0), length, 1.0)
        return torch.where(sign < 0.0, -length, length) * shown

    def shown_body_rates(self) -> Tensor:
        """Gyro in the recording's body frame."""
        rates = self.scene.frames.in_body(self.in_unit(self.body_rates))
        return rates + _widen(self.scene.vector("body_rates_offset"))

    def shown_specific_force(self) -> Tensor:
        """Accelerometer in the recording's body frame, mean over the step before."""
        gravity = self.position.new_tensor([0.0, 0.0, GRAVITY])
        specific = turned_back(self.halfway, self.acceleration - gravity)
        scale = _widen(self.scene.scalar("accelerometer_scale"))[..., None]
        shown = self.scene.frames.in_body(scale * self.in_unit(specific))
        return shown + _widen(self.scene.vector("accelerometer_offset"))

    def shown_specific_force_in_world(self) -> Tensor:
        """The accelerometer's reading, turned into the recording's world."""
        frames = self.scene.frames
        reading = self.shown_specific_force()
        return turned(frames.rotation(self.facing), reading)

    def shown_acceleration(self) -> Tensor:
        """Likewise, with gravity taken off: zero at rest."""
        gravity = self.position.new_tensor([0.0, 0.0, GRAVITY])
        return self.shown_specific_force_in_world() + self.scene.frames.in_world(gravity)

    def _pick_measured(self, group: str) -> Tensor:
        """Readings of a group in the record, (num_windows, length, width); NaN where none."""
        scene = self.scene
        start = sum(len(SENSORS[g]) for g in scene.sensors[: scene.sensors.index(group)])
        columns = range(start, start + len(SENSORS[group]))
        measured = scene.windows.measured
        if scene.columns is None:
            return measured[..., list(columns)]
        out = measured.new_full((*measured.shape[:2], len(columns)), torch.nan)
        for channel, column in enumerate(scene.columns):
            if column in columns:
                out[..., column - start] = measured[..., channel]
        return out


_GROUPS: dict[str, Callable[[_ShownStates], Tensor]] = {
    "position": _ShownStates.shown_position,
    "velocity": _ShownStates.shown_velocity,
    "attitude": _ShownStates.shown_attitude,
    "quaternion": _ShownStates.shown_quaternion,
    "body_rates": _ShownStates.shown_body_rates,
    "accelerometer": _ShownStates.shown_specific_force,
    "specific_force_in_world": _ShownStates.shown_specific_force_in_world,
    "acceleration": _ShownStates.shown_acceleration,
}


@dataclass(frozen=True, eq=False)
class WindowGrid(Grid):
    """Times in windows of one length: a memory knows one window, a formula the run's time."""

    starts: Tensor  # time of each window's first sample in the run, (num_windows, 1, 1, 1) [s]

    @classmethod
    def of_flight(cls, scene: RecordedScene) -> WindowGrid:
        """That of a flight's readings."""
        windows, length = scene.windows.measured.shape[:2]
        starts = scene.dt * length * torch.arange(windows, dtype=torch.float64)
        even = Grid.even(length, scene.dt)
        return cls(even.times, even.samples, even.seconds, starts.reshape(-1, 1, 1, 1))

    @property
    def since_start(self) -> Tensor:
        """Time since the run's first sample, (num_windows, 1, 1, length) [s]."""
        return self.starts + self.times


def read(scene: RecordedScene, record: SensedRecord) -> Tensor:
    """Readings of the sensors, (points, num_windows, length, num_channels)."""
    out = _show_at_once(scene, record, range(scene.windows.measured.shape[-1]))
    for channels, delay in delays_of(scene.instruments.clocks).items():
        out = _replace_channels(
            out, channels, _show_at_once(scene, record.before(delay, scene.dt), channels)
        )
    if not scene.instruments.readings:
        return out
    grid, signals = WindowGrid.of_flight(scene), out.permute(1, 0, 3, 2)
    for channels, change in scene.instruments.readings:
        signals = change_rows(signals, channels, _in_windows(change), grid)
    return signals.permute(1, 0, 3, 2)


def _in_windows(change: SignalMap) -> SignalMap:
    """A map of readings; a lag enters each window in a steady slope: windows begin in motion."""
    if isinstance(change, SignalChange) and change.map is lagged:
        return replace(change, map=lagged_in_windows)
    return change


def _show_at_once(scene: RecordedScene, record: SensedRecord, channels: Sequence[int]) -> Tensor:
    """What some channels would show at once, (points, num_windows, length, len(channels))."""
    shown = _ShownStates.of(scene, record)
    columns = channels if scene.columns is None else [scene.columns[k] for k in channels]
    parts, start = [], 0
    place: dict[int, int] = {}
    for name in scene.sensors:
        asked = range(start, start + len(SENSORS[name]))
        if not set(asked).isdisjoint(columns):
            place |= {column: len(place) + k for k, column in enumerate(asked)}
            parts.append(_GROUPS[name](shown))
        start = asked.stop
    return torch.cat(parts, -1)[..., [place[column] for column in columns]]


def _replace_channels(out: Tensor, channels: tuple[int, ...], changed: Tensor) -> Tensor:
    """Some channels of ``changed``, (..., len(channels)), the others of ``out``."""
    whole = out.expand(*changed.shape[:-1], -1).clone()
    whole[..., list(channels)] = changed
    return whole


def _widen(value: Tensor) -> Tensor:
    """(points, ...) against (points, num_windows, length, ...)."""
    return value[:, None, None]
