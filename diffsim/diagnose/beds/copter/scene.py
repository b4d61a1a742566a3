"""A multicopter under recorded commands in one run, with the places where causes act."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import Tensor

from diffsim.copter import FlightEffects, Multicopter, fly
from diffsim.copter.vehicle import GRAVITY
from diffsim.diagnose.beds.copter.shooting import Shooting, flight_state
from diffsim.errors import ConvergenceError

SENSORS = {
    "position": ("x_m", "y_m", "z_m"),
    "attitude": ("roll_rad", "pitch_rad", "yaw_rad"),
    "body_rates": ("p_rad_s", "q_rad_s", "r_rad_s"),
    "accelerometer": ("ax_m_s2", "ay_m_s2", "az_m_s2"),
}
_MAX_PASSES = 40  # over causes that depend on the motion
_SETTLED = 1e-9  # change of forces from pass to pass [N]

CommandMap = Callable[[Tensor, float], Tensor]
Schedule = Callable[["Motion", Tensor], Tensor]
Air = Callable[["Motion"], Tensor]


def _origin() -> Tensor:
    return torch.zeros(3, dtype=torch.float64)


def _unit() -> Tensor:
    return torch.ones((), dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Motion:
    """What a cause may depend on, in the middle of every control step.

    Attributes:
        vehicle: That flies.
        velocity: World frame, (num_windows, length, 3) [m/s].
        rotation: World from body, (num_windows, length, 3, 3).
        body_rates: (num_windows, length, 3) [rad/s].
    """

    vehicle: Multicopter
    velocity: Tensor
    rotation: Tensor
    body_rates: Tensor

    @property
    def body_velocity(self) -> Tensor:
        """(num_windows, length, 3) [m/s]."""
        return (self.rotation.mT @ self.velocity[..., None])[..., 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class CopterScene:
    """One run; effects return changed copies.

    A force in the world is exact without a term of its own in the dynamics: seen from a frame that
    accelerates with a = F / m it is absent, and the drags feel a wind, less the frame's velocity.
    (Ground effect then sees a height that is off by the frame's way, a_z t^2 / 2.)

    Attributes:
        vehicle: The multicopter.
        commands: Thrusts at every sample, held until the next, (num_samples, n_rotors) [N].
        dt: Between samples [s].
        sensors: Groups of channels of the record, in order; keys of ``SENSORS``.
        shooting: Windows and their initial states.
        substeps: Integration steps per sample.
        flight_effects: Of :func:`diffsim.copter.fly`; tensors without batch axis.
        terrain_height: Of the ground above the origin [m].
        command_maps: What happens to the commands, in order: f(commands, dt).
        schedules: What happens to thrusts in flight: f(motion, thrusts) with thrusts of
            (num_windows, length, n_rotors); iterated to a fixed point.
        air: Forces in the world that depend on the motion: f(motion) of (num_windows, length, 3)
            [N]; iterated likewise.
        world_force: (3,), or (num_samples, 3) held over each step [N].
        marker: Place of the captured point in the body frame, (3,) [m].
        imu_tilt: Rotation vector of the inertial unit in the body frame, small, (3,) [rad].
        position_scale, accelerometer_scale: What these show over what is there [-].
        attitude_offset, body_rates_offset, accelerometer_offset: Added to what these show, (3,)
            [rad], [rad/s], [m/s^2].
    """

    vehicle: Multicopter
    commands: Tensor
    dt: float
    sensors: tuple[str, ...]
    shooting: Shooting
    substeps: int = 2
    flight_effects: FlightEffects = field(default_factory=FlightEffects)
    terrain_height: float = 0.0
    command_maps: tuple[CommandMap, ...] = ()
    schedules: tuple[Schedule, ...] = ()
    air: tuple[Air, ...] = ()
    world_force: Tensor = field(default_factory=_origin)
    marker: Tensor = field(default_factory=_origin)
    imu_tilt: Tensor = field(default_factory=_origin)
    position_scale: Tensor = field(default_factory=_unit)
    accelerometer_scale: Tensor = field(default_factory=_unit)
    attitude_offset: Tensor = field(default_factory=_origin)
    body_rates_offset: Tensor = field(default_factory=_origin)
    accelerometer_offset: Tensor = field(default_factory=_origin)

    def changed(self, **changes: Any) -> CopterScene:
        """A copy with some entries replaced."""
        return replace(self, **changes)

    def with_command(self, change: CommandMap) -> CopterScene:
        """A copy whose commands are changed on their way: f(commands, dt) -> commands."""
        return self.changed(command_maps=(*self.command_maps, change))

    def with_schedule(self, change: Schedule) -> CopterScene:
        """A copy whose thrusts depend on the motion."""
        return self.changed(schedules=(*self.schedules, change))

    def with_air(self, force: Air) -> CopterScene:
        """A copy with one more force that depends on the motion."""
        return self.changed(air=(*self.air, force))

    def with_flight_effect(self, name: str, value: Any) -> CopterScene:
        """A copy with one entry of ``flight_effects`` replaced."""
        return self.changed(flight_effects=replace(self.flight_effects, **{name: value}))

    def simulate(self) -> Tensor:
        """Predicted channels, (num_samples, num_channels)."""
        return simulate_many([self])[0]


def simulate_many(scenes: Sequence[CopterScene]) -> list[Tensor]:
    """Predictions of scenes of one run, flown as one batch.

    Returns:
        (num_samples, num_channels) each.
    """
    first = scenes[0]
    windows, length, _ = first.shooting.measured.shape
    thrusts = torch.stack([windowed(steps_of(_heard(s)), windows, length) for s in scenes])

    def predict(start: Tensor) -> Tensor:
        return fly_windows(scenes, start, thrusts)

    channels = first.shooting.profile(predict, len(scenes))
    samples = first.commands.shape[0]
    return [c.reshape(windows * length, -1)[:samples] for c in channels]


def fly_windows(scenes: Sequence[CopterScene], start: Tensor, thrusts: Tensor) -> Tensor:
    """Channels of all windows of all scenes.

    Args:
        scenes: Of one run.
        start: States of 12, (num_scenes, num_windows, 12).
        thrusts: Held over the steps from the start, (num_scenes, num_windows, length, n_rotors)
            [N].

    Returns:
        At the end of every step, (num_scenes, num_windows, length, num_channels).

    Raises:
        ConvergenceError: forces that depend on the motion did not settle.
    """
    records = _fly(scenes, start, thrusts)
    if any(s.schedules or s.air for s in scenes):
        records = _settle(scenes, start, thrusts, records)
    return torch.stack([_read(s, r) for s, r in zip(scenes, records, strict=True)])


def windowed(values: Tensor, windows: int, length: int) -> Tensor:
    """(num_samples, width) -> (windows, length, width); the last row fills up the last window."""
    missing = windows * length - values.shape[0]
    padded = torch.cat([values, values[-1:].expand(missing, -1)])
    return padded.reshape(windows, length, -1)


def steps_of(values: Tensor) -> Tensor:
    """What is held over the step that ends at each sample, (num_samples, width).

    Windows start one sample early, for the accelerometer shows the mean over the step before. What
    came before the record equals its first sample.
    """
    return torch.cat([values[:1], values[:-1]])


def _heard(scene: CopterScene) -> Tensor:
    commands = scene.commands
    for change in scene.command_maps:
        commands = change(commands, scene.dt)
    return commands


@dataclass(frozen=True, eq=False)
class _Record:
    """States of a scene's windows, (num_windows, length + 1, ...), the one after the last too."""

    position: Tensor
    velocity: Tensor
    rotation: Tensor
    rpy: Tensor
    body_rates: Tensor

    def motion(self, vehicle: Multicopter) -> Motion:
        """In the middle of steps, where causes are right to second order."""
        middle = [
            0.5 * (value[:, :-1] + value[:, 1:])
            for value in (self.velocity, self.rotation, self.body_rates)
        ]
        return Motion(vehicle, *middle)


def _settle(
    scenes: Sequence[CopterScene], start: Tensor, thrusts: Tensor, records: list[_Record]
) -> list[_Record]:
    """Forces follow from the motion, and it from them: repeated until they stay."""
    before = torch.cat([thrusts.detach(), torch.zeros_like(thrusts[..., :3])], -1)
    change = torch.zeros(())
    for _ in range(_MAX_PASSES):
        motions = [r.motion(s.vehicle) for s, r in zip(scenes, records, strict=True)]
        flown = torch.stack(
            [_scheduled(s, m, u) for s, m, u in zip(scenes, motions, thrusts, strict=True)]
        )
        air = torch.stack([_air(s, m) for s, m in zip(scenes, motions, strict=True)])
        records = _fly(scenes, start, flown, air)
        now = torch.cat([flown.detach(), air.detach()], -1)
        change = (now - before).abs().max()
        if float(change) < _SETTLED:
            return records
        before = now
    raise ConvergenceError(
        f"forces that depend on the motion still change by {float(change):.1e} N after "
        f"{_MAX_PASSES} passes; shorten the windows or reduce the effects' sizes",
        residual_norm=float(change),
        tolerance=_SETTLED,
        num_iters=_MAX_PASSES,
    )


def _scheduled(scene: CopterScene, motion: Motion, thrusts: Tensor) -> Tensor:
    for change in scene.schedules:
        thrusts = change(motion, thrusts)
    return thrusts


def _air(scene: CopterScene, motion: Motion) -> Tensor:
    total = torch.zeros_like(motion.velocity)
    for force in scene.air:
        total = total + force(motion)
    return total


def _fly(
    scenes: Sequence[CopterScene], start: Tensor, thrusts: Tensor, air: Tensor | None = None
) -> list[_Record]:
    """Flights under thrusts, and forces ``air`` in the world, (num_scenes, ..., 3) [N]."""
    first = scenes[0]
    many, windows, length, rotors = thrusts.shape
    copies = windows // first.shooting.start.shape[0]
    force = torch.stack([_world_force(s, length).repeat(copies, 1, 1) for s in scenes])
    mass = torch.stack([s.vehicle.mass for s in scenes])
    pull = (force if air is None else force + air) / mass[:, None, None, None]
    frame = _Frame.of(pull.reshape(-1, length, 3), first.dt)
    vehicles = [s.vehicle for s in scenes for _ in range(windows)]
    flight = fly(
        vehicles if many > 1 else first.vehicle,
        flight_state(start.reshape(-1, 12)),
        thrusts.reshape(-1, length, rotors).contiguous(),
        dt=first.dt,
        substeps=first.substeps,
        effects=_merged(scenes, windows, frame),
    )
    state = flight.state
    parts = (
        state.position + frame.way,
        state.velocity + frame.velocity,
        state.rotation,
        state.rpy,
        state.body_rates,
    )
    shaped = [p.reshape(many, windows, length + 1, *p.shape[2:]) for p in parts]
    return [_Record(*(p[i] for p in shaped)) for i in range(many)]


@dataclass(frozen=True, eq=False)
class _Frame:
    """The accelerating frame in which forces in the world are absent.

    Attributes:
        way, velocity: Since the window began, (batch, length + 1, 3) [m], [m/s].
    """

    way: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, pull: Tensor, dt: float) -> _Frame:
        """From accelerations held over each step, (batch, length, 3) [m/s^2]."""
        zero = torch.zeros_like(pull[:, :1])
        velocity = torch.cat([zero, (dt * pull).cumsum(1)], 1)
        steps = dt * (velocity[:, :-1] + 0.5 * dt * pull)
        return cls(torch.cat([zero, steps.cumsum(1)], 1), velocity)


def _world_force(scene: CopterScene, length: int) -> Tensor:
    """(num_windows, length, 3) [N]."""
    windows = scene.shooting.start.shape[0]
    if scene.world_force.dim() == 1:
        return scene.world_force.expand(windows, length, 3)
    return windowed(steps_of(scene.world_force), windows, length)


def _merged(scenes: Sequence[CopterScene], windows: int, frame: _Frame) -> FlightEffects:
    """The scenes' effects with a batch axis, and the wind of their accelerating frames."""
    together: dict[str, Any] = {}
    for entry in fields(FlightEffects):
        values = [getattr(s.flight_effects, entry.name) for s in scenes]
        if entry.name == "wind" or all(v is None for v in values):
            continue
        if any(v is None for v in values):
            raise ValueError(f"either all scenes of a batch have {entry.name} or none")
        rows = {
            f.name: torch.stack([getattr(v, f.name) for v in values]).repeat_interleave(windows, 0)
            for f in fields(values[0])
        }
        together[entry.name] = type(values[0])(**rows)
    if "rotor_drag" in together or "body_drag" in together:
        wind = -0.5 * (frame.velocity[:, :-1] + frame.velocity[:, 1:])
        steady = [s.flight_effects.wind for s in scenes]
        if any(w is not None for w in steady):
            blown = [torch.zeros(3, dtype=torch.float64) if w is None else w for w in steady]
            wind = wind + torch.stack(blown).repeat_interleave(windows, 0)[:, None]
        together["wind"] = wind
    return FlightEffects(**together)


def _read(scene: CopterScene, record: _Record) -> Tensor:
    """What the sensors show, (num_windows, length, num_channels)."""
    rotation = record.rotation[:, 1:]
    seen = record.position[:, 1:] + (rotation @ scene.marker[:, None])[..., 0]
    # the mean over the step before
    acceleration = record.velocity.diff(dim=1) / scene.dt
    halfway = 0.5 * (record.rotation[:, :-1] + rotation)
    gravity = seen.new_tensor([0.0, 0.0, GRAVITY])
    specific = (halfway.mT @ (acceleration - gravity)[..., None])[..., 0]

    def in_unit(value: Tensor) -> Tensor:
        return value - torch.linalg.cross(scene.imu_tilt.expand_as(value), value)

    channels = {
        "position": scene.position_scale * seen,
        "attitude": record.rpy[:, 1:] + scene.attitude_offset,
        "body_rates": in_unit(record.body_rates[:, 1:]) + scene.body_rates_offset,
        "accelerometer": scene.accelerometer_scale * in_unit(specific) + scene.accelerometer_offset,
    }
    return torch.cat([channels[name] for name in scene.sensors], -1)
