"""The conditions of a flight: vehicle, recorded commands, and the hooks where causes act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from diffsim.copter import FlightEffects
from diffsim.copter.fleet import Fleet
from diffsim.systems.multicopter.estimator import BlindEstimator, force_of
from diffsim.systems.multicopter.frames import Frames
from diffsim.systems.multicopter.motion import Motion
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

CommandMap = Callable[[Tensor, float], Tensor]
Schedule = Callable[[Motion, Tensor], Tensor]
Air = Callable[[Motion], Tensor]


def _origin() -> Tensor:
    return torch.zeros(1, 3, dtype=torch.float64)


def _unit() -> Tensor:
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
        command_maps: Functions f(commands, dt) that change the commands, in order. The first row is
            what was held before the record starts, so that commands are (points, num_samples + 1,
            n_rotors) there.
        schedules: Functions f(motion, thrusts) that change the thrusts in flight, (points,
            num_windows, length, n_rotors) [N]; iterated to a fixed point.
        air: Forces in the world that depend on the motion: f(motion) of (points, num_windows,
            length, 3) [N]; iterated likewise.
        world_force: (points, num_samples or 1, 3), held over each step [N].
        marker: Place of the captured point in the body frame, (points, 3) [m].
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
        readers: Channels by their indices, and what happens to their readings (points, num_windows,
            length, width).
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
    frames: Frames = field(default_factory=Frames)
    substeps: int = 2
    flight_effects: FlightEffects = field(default_factory=FlightEffects)
    terrain_height: float = 0.0
    thrust_coefficient: float = 1e-5
    command_maps: tuple[CommandMap, ...] = ()
    schedules: tuple[Schedule, ...] = ()
    air: tuple[Air, ...] = ()
    world_force: Tensor = field(default_factory=lambda: _origin()[None])
    marker: Tensor = field(default_factory=_origin)
    imu_tilt: Tensor = field(default_factory=_origin)
    position_scale: Tensor = field(default_factory=_unit)
    accelerometer_scale: Tensor = field(default_factory=_unit)
    ground_scale: Tensor = field(default_factory=_unit)
    attitude_offset: Tensor = field(default_factory=_origin)
    body_rates_offset: Tensor = field(default_factory=_origin)
    accelerometer_offset: Tensor = field(default_factory=_origin)
    camera_delay: Tensor | None = None
    late: tuple[tuple[tuple[int, ...], Tensor], ...] = ()
    readers: tuple[tuple[tuple[int, ...], Callable[[Tensor], Tensor]], ...] = ()
    sling_length: Tensor | None = None
    gust_frequency: Tensor | None = None
    estimator_gains: Tensor | None = None
    estimator: BlindEstimator | None = None

    def changed(self, **changes: Any) -> Self:
        """A copy with some entries replaced."""
        return replace(self, **changes)

    def with_command(self, change: CommandMap) -> Self:
        """A copy whose commands are changed on their way: f(commands, dt) -> commands."""
        return self.changed(command_maps=(*self.command_maps, change))

    def with_schedule(self, change: Schedule) -> Self:
        """A copy whose thrusts depend on the motion."""
        return self.changed(schedules=(*self.schedules, change))

    def with_air(self, force: Air) -> Self:
        """A copy with one more force that depends on the motion."""
        return self.changed(air=(*self.air, force))

    def with_late(self, channels: tuple[int, ...], delay: Tensor) -> Self:
        """A copy in which some channels show what was ``delay`` ago, (points,) [s]."""
        return self.changed(late=(*self.late, (channels, delay)))

    def with_reading(self, channels: tuple[int, ...], change: Callable[[Tensor], Tensor]) -> Self:
        """A copy in which the readings of some channels are changed."""
        return self.changed(readers=(*self.readers, (channels, change)))

    def with_flight_effect(self, name: str, value: Any) -> Self:
        """A copy with one entry of ``flight_effects`` replaced."""
        return self.changed(flight_effects=replace(self.flight_effects, **{name: value}))

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
        for change in self.command_maps:
            commands = change(commands, self.dt)
        return commands[:, :-1]


def amount(size: Tensor, axes: int) -> Tensor:
    """The first component, with the leading axis and ``axes`` more of one."""
    return size[..., 0].reshape(-1, *[1] * axes)


def vector(size: Tensor, width: int = 3) -> Tensor:
    """Components, (points, width), filled up with zeros."""
    rows = size.reshape(-1, size.shape[-1])
    return torch.nn.functional.pad(rows, (0, width - rows.shape[-1]))
