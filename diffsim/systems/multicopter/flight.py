"""The conditions of a flight: vehicle, recorded commands, and the hooks where causes act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffsim.causes.ports import SignalChange
from diffsim.causes.scene import ForceLaw
from diffsim.causes.signals import Grid, SignalMap, lagged
from diffsim.copter import FlightEffects
from diffsim.copter.vehicle.fleet import Fleet
from diffsim.systems.multicopter.estimator import BlindEstimator, force_of
from diffsim.systems.multicopter.frames import RecordingFrames
from diffsim.systems.multicopter.lag import lagged_in_windows
from diffsim.systems.multicopter.motion import FlightMotion
from diffsim.systems.multicopter.shooting import Windows

if TYPE_CHECKING:
    from typing_extensions import Self

SENSORS = {
    "position": ("x_m", "y_m", "z_m"),
    "attitude": ("roll_rad", "pitch_rad", "yaw_rad"),
    "body_rates": ("p_rad_s", "q_rad_s", "r_rad_s"),
    "accelerometer": ("ax_m_s2", "ay_m_s2", "az_m_s2"),
    "velocity": ("vx_m_s", "vy_m_s", "vz_m_s"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "specific_force_in_world": ("fx_m_s2", "fy_m_s2", "fz_m_s2"),
    "acceleration": ("ax_world_m_s2", "ay_world_m_s2", "az_world_m_s2"),
}

AXES = ("x", "y", "z")  # of the recording's world: places at which forces may act
FADES = 0.01  # speed below which dry friction fades [m/s]

Schedule = Callable[[FlightMotion, Tensor], Tensor]
Air = Callable[[FlightMotion], Tensor]


def _make_origin() -> Tensor:
    return torch.zeros(1, 3, dtype=torch.float64)


def _make_unit() -> Tensor:
    return torch.ones(1, dtype=torch.float64)


@dataclass(frozen=True, kw_only=True, eq=False)
class CopterFlight:
    """One run at many points of the parameters; effects return changed copies.

    Every tensor has a leading axis: one row per point, or one for all. A size of an effect is
    (num_components,) for one point or (num_points, num_components); ``amount`` and ``vector`` bring
    it to the shapes that are needed here.

    Attributes:
        vehicle: The multicopter, (points, ...).
        commands: Thrusts at every sample, held until the next, (points, num_samples, n_rotors) [N].
        dt: Time between two samples [s].
        sensors: Groups of channels of the record, in order; keys of ``SENSORS``.
        columns: Which reading each channel is, counted over the groups; None: all, in order.
        frames: Frames that the record is written in.
        windows: The record in windows, whose initial states are fitted away.
        substeps: Integration steps per sample.
        flight_effects: Effects in flight, as :func:`diffsim.copter.fly` takes them; tensors with
            the leading axis.
        terrain_height: Height of the ground above the origin [m].
        thrust_coefficient: Thrust over the square of a rotor's speed [N s^2].
        command_maps: Rotors by their indices (none: all), and what happens to their commands
            (points, n_rotors, num_samples + 1), in order. The first of these is what was held
            before the record starts.
        schedules: Functions f(motion, thrusts) that change the thrusts in flight, (points,
            num_windows, length, n_rotors) [N]; iterated to a fixed point.
        air: Forces in the world that depend on the motion: f(motion) of (points, num_windows,
            length, 3) [N]; iterated likewise.
        world_force: (points, num_samples or 1, 3), held over each step [N].
        marker: Place of the captured point in the body frame, (points, 3) [m].
        center_of_mass: How far causes moved it from where the rotors are placed from, in the body
            frame of the recording, (points, 3) [m].
        imu_tilt: Rotation vector of the inertial unit in the body frame, small, (points, 3) [rad].
        position_scale, accelerometer_scale: Scale of the position and of the accelerometer
            readings, shown over true, (points,) [-].
        ground_scale: Scale of the position along the ground alone, likewise.
        attitude_offset, body_rates_offset, accelerometer_offset: Added to what these show,
            (points, 3) [rad], [rad/s], [m/s^2], in the recording's frames.
        camera_delay: Age of the position, velocity and attitude that are shown, (points,) [s];
            None: none.
        late: Channels of an instrument by their indices, and how late it is, (points,) [s];
            added up.
        readers: Channels by their indices (none: all), and what happens to their readings
            (num_windows, points, width, length).
        sling_length: Of a string that a load may hang on, (points,) [m]; None: 0.5 m.
        gust_frequency: Of a gust that there may be, (points,) [Hz]; None: no gust.
        estimator_gains: Of an estimator that shows velocity and attitude, (points, 3), as
            ``BlindEstimator`` has them; None: they are shown as they are.
        estimator: Its errors; None: none.
    """

    vehicle: Fleet
    commands: Tensor
    dt: float
    sensors: tuple[str, ...]
    windows: Windows
    columns: tuple[int, ...] | None = None
    frames: RecordingFrames = field(default_factory=RecordingFrames)
    substeps: int = 2
    flight_effects: FlightEffects = field(default_factory=FlightEffects)
    terrain_height: float = 0.0
    thrust_coefficient: float = 1e-5
    command_maps: tuple[tuple[tuple[int, ...], SignalMap], ...] = ()
    schedules: tuple[Schedule, ...] = ()
    air: tuple[Air, ...] = ()
    world_force: Tensor = field(default_factory=lambda: _make_origin()[None])
    marker: Tensor = field(default_factory=_make_origin)
    center_of_mass: Tensor = field(default_factory=_make_origin)
    imu_tilt: Tensor = field(default_factory=_make_origin)
    position_scale: Tensor = field(default_factory=_make_unit)
    accelerometer_scale: Tensor = field(default_factory=_make_unit)
    ground_scale: Tensor = field(default_factory=_make_unit)
    attitude_offset: Tensor = field(default_factory=_make_origin)
    body_rates_offset: Tensor = field(default_factory=_make_origin)
    accelerometer_offset: Tensor = field(default_factory=_make_origin)
    camera_delay: Tensor | None = None
    late: tuple[tuple[tuple[int, ...], Tensor], ...] = ()
    readers: tuple[tuple[tuple[int, ...], SignalMap], ...] = ()
    sling_length: Tensor | None = None
    gust_frequency: Tensor | None = None
    estimator_gains: Tensor | None = None
    estimator: BlindEstimator | None = None
    play_start: None = None  # in the middle: windows begin wherever they were found to

    def changed(self, **changes: Any) -> Self:
        """A copy with some entries replaced."""
        return replace(self, **changes)

    def with_command(self, names: tuple[str, ...], change: SignalMap) -> Self:
        """A copy in which the thrusts that some rotors are asked for are changed on their way.

        Args:
            names: Rotors as ``rotor_names`` calls them; empty: all.
            change: Function f(thrusts (..., width, num_samples + 1), grid).
        """
        known = rotor_names(self.vehicle.num_rotors)
        rotors = tuple(known.index(name) for name in names)
        return self.changed(command_maps=(*self.command_maps, (rotors, change)))

    def with_schedule(self, change: Schedule) -> Self:
        """A copy whose thrusts depend on the motion."""
        return self.changed(schedules=(*self.schedules, change))

    def with_air(self, force: Air) -> Self:
        """A copy with one more force that depends on the motion."""
        return self.changed(air=(*self.air, force))

    def with_force(self, place: str, law: ForceLaw) -> Self:
        """A copy with one more force on the center of mass, along one of ``AXES``."""
        axis, frames = AXES.index(place), self.frames
        along = torch.eye(3, dtype=torch.float64)[axis]

        def push(motion: FlightMotion) -> Tensor:
            way, speed = (frames.in_world(v)[..., axis] for v in (motion.position, motion.velocity))
            size, fades = law.size.reshape(-1, 1, 1), way.new_tensor(FADES)
            force = law.formula({"size": size, "x": way, "v": speed, "w": fades})
            return frames.in_world(force[..., None] * along)

        return self.with_air(push)

    def with_clock(self, channels: tuple[int, ...], delay: Tensor) -> Self:
        """A copy in which some channels show what was ``delay`` ago, () or (points,) [s]."""
        return self.changed(late=(*self.late, (channels, delay.reshape(-1))))

    def with_reading(self, channels: tuple[int, ...], change: SignalMap) -> Self:
        """A copy in which some readings are f(readings (..., width, length), grid of a window).

        A lag enters each window in a steady slope: windows begin in motion.
        """
        if isinstance(change, SignalChange) and change.map is lagged:
            change = replace(change, map=lagged_in_windows)
        return self.changed(readers=(*self.readers, (channels, change)))

    def force_by_record(self) -> Tensor:
        """Specific force of the commanded thrust at the recorded attitudes, (points, num_samples,
        3) [m/s^2]."""
        push = self.commands.sum(-1) / self.vehicle.mass[:, None]
        return force_of(self.windows.states, push)

    def delivered(self, past: Tensor) -> Tensor:
        """Thrusts over the steps that end at the samples, (points, num_samples, n_rotors) [N].

        Args:
            past: Held before the first sample, (points, n_rotors) [N].
        """
        points = past.shape[0]
        commands = torch.cat(
            [past[:, None], self.commands.expand(points, *self.commands.shape[1:])], 1
        )
        return self.on_their_way(commands)[:, :-1]

    def on_their_way(self, commands: Tensor) -> Tensor:
        """What becomes of commands (points, num_samples + 1, n_rotors) before they are thrusts."""
        even = Grid.even(commands.shape[1], self.dt)
        grid = replace(even, samples=even.samples[1:], seconds=even.seconds[1:])
        signals = commands.mT
        for rotors, change in self.command_maps:
            signals = change_some(signals, rotors, change, grid)
        return signals.mT


def rotor_names(count: int) -> tuple[str, ...]:
    """Names of the rotors, whose thrusts are the commands of a flight."""
    return tuple(f"rotor_{i + 1}" for i in range(count))


def change_some(signals: Tensor, which: tuple[int, ...], change: SignalMap, grid: Grid) -> Tensor:
    """Signals (..., width, num_times) with some of them, or all if none is named, changed."""
    if not which:
        return change(signals, grid)
    changed = change(signals[..., list(which), :], grid)
    whole = signals.expand(*changed.shape[:-2], -1, -1).clone()
    whole[..., list(which), :] = changed
    return whole


def amount(size: Tensor, axes: int) -> Tensor:
    """The first component, with the leading axis and ``axes`` more of one."""
    return size[..., 0].reshape(-1, *[1] * axes)


def vector(size: Tensor, width: int = 3) -> Tensor:
    """Components, (points, width), filled up with zeros."""
    rows = size.reshape(-1, size.shape[-1])
    return torch.nn.functional.pad(rows, (0, width - rows.shape[-1]))
