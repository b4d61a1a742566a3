"""A multicopter under recorded commands in one run, ready to be simulated."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from diffsim.causes.scene import ForceLaw
from diffsim.causes.signals import Grid
from diffsim.copter import FlightEffects, FlightError, FlightState, prepare_flight
from diffsim.copter.vehicle.effects import BodyDrag, RotorDrag
from diffsim.copter.vehicle.multicopter import Fleet
from diffsim.core.checked import checked
from diffsim.core.errors import ConvergenceError
from diffsim.core.layer import may_be_differentiated
from diffsim.systems.multicopter.estimator import force_of
from diffsim.systems.multicopter.frames import AXES, RecordingFrames
from diffsim.systems.multicopter.motion import FlightMotion
from diffsim.systems.multicopter.readings import SCALES, RecordedScene, SensedRecord, read
from diffsim.systems.multicopter.shooting import (
    MAX_STEPS,
    RIGID,
    FlightShooting,
    flight_state,
)

_MAX_PASSES = 40  # over causes that depend on the motion
_SETTLED = 1e-8  # change of forces from pass to pass [N]
_PART = 5  # steps that settle together where whole windows do not
_MORE_FOR_GRADIENTS = 2  # passes: derivatives settle after the values

Schedule = Callable[[FlightMotion, Tensor], Tensor]
Air = Callable[[FlightMotion], Tensor]

_OF_FLEET = {"mass": "mass", "inertia": "inertia", "torque_ratio": "torque_ratios"}
_VECTORS = ("world_force", "center_of_mass", "placement", "sensor_tilt")
_OFFSETS = ("attitude_offset", "body_rates_offset", "accelerometer_offset")
#: Numbers that are zero until a cause or a nuisance changes them.
ZEROS = (
    *("rotor_drag", "body_drag", "camera_delay"),
    *(f"{vector}_{axis}" for vector in (*_VECTORS, *_OFFSETS) for axis in AXES),
)
NUMBERS = (*_OF_FLEET, *SCALES, *ZEROS)


@dataclass(frozen=True, kw_only=True, eq=False)
class CopterScene(RecordedScene):
    """One run at many points of the parameters; initial states of its windows are fitted away.

    Every tensor has a leading axis: one row per point, or one for all. Numbers have it last. A size
    of an effect is (num_components,) for one point or (num_points, num_components); ``amount`` and
    ``vector`` bring it to the shapes that are needed here.

    Commands are thrusts of ``rotor_names``, (points, n_rotors, num_samples) [N], each held until
    the next; on their way they have one more in front, which was held before the record starts.
    Forces of causes act on the center of mass, along one of ``AXES``.

    Attributes:
        fleet: The multicopter before causes change its numbers, (points, ...).
        substeps: Integration steps per sample.
        terrain_height: Height of the ground above the origin [m].
        thrust_coefficient: Thrust over the square of a rotor's speed [N s^2].
        schedules: Functions f(motion, thrusts) that change the thrusts in flight, (points,
            num_windows, length, n_rotors) [N]; iterated to a fixed point.
        air: Forces in the world that depend on the motion: f(motion) of (points, num_windows,
            length, 3) [N]; iterated likewise.
        world_force: (points, num_samples or 1, 3), held over each step, beside the number [N].
        point: Point of the parameters, by which its initial states are known again; None: unknown.
        note: Told of every flight, also of each pass over forces that depend on the motion, with
            the number of starts that fly side by side; None: nobody counts.
    """

    zeros: Collection[str] = ZEROS
    fleet: Fleet
    substeps: int = 2
    terrain_height: float = 0.0
    thrust_coefficient: float = 1e-5
    schedules: tuple[Schedule, ...] = ()
    air: tuple[Air, ...] = ()
    world_force: Tensor = field(default_factory=lambda: torch.zeros(1, 1, 3, dtype=torch.float64))
    point: Hashable | None = None
    note: Callable[[int], None] | None = None

    def number(self, name: str) -> Tensor:
        """A number as it is in this run, (..., points)."""
        if name in _OF_FLEET and name not in self.numbers:
            value: Tensor = getattr(self.fleet, _OF_FLEET[name])
            return value.movedim(0, -1)
        return super().number(name)

    @checked(kinds_only=True)
    def with_schedule(self, change: Schedule) -> CopterScene:
        """A copy whose thrusts depend on the motion."""
        return replace(self, schedules=(*self.schedules, change))

    @checked(kinds_only=True)
    def with_air(self, force: Air) -> CopterScene:
        """A copy with one more force that depends on the motion."""
        return replace(self, air=(*self.air, force))

    @property
    def num_samples(self) -> int:
        """Number of samples of the record."""
        return self.commands.values.shape[-1]

    @cached_property
    def vehicle(self) -> Fleet:
        """The multicopter as it is in this run, (points, ...)."""
        with torch.enable_grad():  # it is kept, and a search for starts, without gradients, may ask
            changed = {
                field: self.numbers[name].movedim(-1, 0)
                for name, field in _OF_FLEET.items()
                if name in self.numbers
            }
            if any(f"center_of_mass_{axis}" in self.numbers for axis in AXES):
                shift = self.frames.in_body(self.vector("center_of_mass"))
                changed["positions"] = self.fleet.positions - shift[:, None]
            return self.fleet.replace(**changed) if changed else self.fleet

    @property
    def effects(self) -> FlightEffects:
        """The drags, that of the body across its z axis."""
        found = FlightEffects()
        if "rotor_drag" in self.numbers:
            drag = RotorDrag(coefficient=self.scalar("rotor_drag"))
            found = replace(found, rotor_drag=drag)
        if "body_drag" in self.numbers:
            along = self.scalar("body_drag")
            linear = torch.stack([along, along, torch.zeros_like(along)], -1)
            none = torch.zeros(1, 3, dtype=torch.float64)
            found = replace(found, body_drag=BodyDrag(linear=linear, quadratic=none))
        return found

    @property
    def pushes(self) -> Tensor:
        """Forces in the world that do not depend on the motion, (points, num_samples or 1, 3)."""
        if all(f"world_force_{axis}" not in self.numbers for axis in AXES):
            return self.world_force
        return self.frames.in_world(self.vector("world_force"))[:, None] + self.world_force

    def force_by_record(self) -> Tensor:
        """Specific force of the commanded thrust at the recorded attitudes, (points, num_samples,
        3) [m/s^2]."""
        push = self.commands.values.mT.sum(-1) / self.vehicle.mass[:, None]
        return force_of(self.windows.states, push)

    @checked(kinds_only=True)
    def delivered(self, past: Tensor) -> Tensor:
        """Thrusts over the steps that end at the samples, (points, num_samples, n_rotors) [N].

        Args:
            past: Held before the first sample, (points, n_rotors) [N].
        """
        asked = self.commands.values.expand(len(past), -1, -1)
        return self.on_their_way(torch.cat([past[..., None], asked], -1))[:, :-1]

    def on_their_way(self, commands: Tensor) -> Tensor:
        """What becomes of commands (points, n_rotors, num_samples + 1), before they are thrusts,
        (points, num_samples + 1, n_rotors)."""
        return self.commands.pass_through(commands, self.grid).mT

    def simulate(self) -> Tensor:
        """Predicted channels of one point, (num_samples, num_channels)."""
        shooting = self.find_starts()
        if may_be_differentiated():
            return self.simulate_many(1, shooting)[0]
        return shooting.at_own_point()[: self.num_samples]

    @checked(kinds_only=True)
    def find_starts(self, max_steps: int = MAX_STEPS) -> FlightShooting:
        """Best initial states of one point and their tangents there, found within some steps; those
        of the last points are kept."""
        if self.point is None:
            return self._search_starts(max_steps)
        return self.windows.known(self.point, lambda: self._search_starts(max_steps))

    def _search_starts(self, max_steps: int) -> FlightShooting:
        flyers: dict[int, Flyer] = {}

        def predict(starts: Tensor) -> Tensor:
            # one for each number of starts: its last forces are the first guess of the next flight
            points = len(starts)
            if points not in flyers:
                flyers[points] = Flyer(self, points, is_one=True)
            return flyers[points](starts)

        return self.windows.find_starts(predict, max_steps)

    @checked(kinds_only=True)
    def simulate_many(self, points: int, shooting: FlightShooting) -> Tensor:
        """Predicted channels with the best initial states.

        Args:
            points: Number of points that the scene's leading axes stand for.
            shooting: Fit of the initial states, of a point near all of them.

        Returns:
            (points, num_samples, num_channels).
        """
        return shooting.profile(Flyer(self, points))[:, : self.num_samples]


class Flyer:
    """Flies all windows of a scene at all its points; keeps the last forces.

    Forces follow from the motion, and it from them: repeated until they stay. Without gradients the
    last forces are the first guess of the next flight. (With them they must not be: values would
    settle at once, but derivatives would not.)

    A force in the world is exact without a term of its own in the dynamics: seen from a frame that
    accelerates with a = F / m it is absent, and the drags act on a wind, less the frame's velocity.

    Args:
        points: Number of points that the scene's leading axes stand for.
        is_one: Whether they are one point of the parameters, flown from many starts.
    """

    def __init__(self, scene: CopterScene, points: int, *, is_one: bool = False):
        self.scene, self.points, self.is_one = scene, points, is_one
        self._last: tuple[Tensor, Tensor] | None = None
        self._prepared = prepare_flight(
            scene.vehicle.repeated(len(scene.windows.measured)),
            dt=scene.dt,
            substeps=scene.substeps,
            clamp=False,
            effects=self._make_effects(),
        )

    def __call__(self, start: Tensor) -> Tensor:
        """Channels at the end of every step, (points, num_windows, length, num_channels).

        Args:
            start: States of 12 and the thrusts held before the record,
                (points or 1, num_windows, 12 + n_rotors); those of the first window count.

        Raises:
            ConvergenceError: forces that depend on the motion did not settle.
        """
        windows, length = self.scene.windows.measured.shape[:2]
        start = start.expand(self.points, -1, -1)
        # no rotor pulls backwards; what a gain or a cause makes of its thrust may lie beyond limits
        thrusts = self._deliver_thrusts(start[:, 0, RIGID:]).clamp(min=0.0)
        return self.fly_thrusts(start[..., :RIGID], windowed(thrusts, windows, length))

    def _deliver_thrusts(self, past: Tensor) -> Tensor:
        """Thrusts as of ``CopterScene.delivered``; those of equal starts once."""
        if not self.is_one or self.points == 1:
            return self.scene.delivered(past)
        rows, of_row = torch.unique(past, dim=0, return_inverse=True)
        return self.scene.delivered(rows)[of_row]

    def fly_thrusts(self, start: Tensor, thrusts: Tensor) -> Tensor:
        """Channels as above.

        Args:
            start: States of 12, (points, num_windows, 12).
            thrusts: Held over the steps from the start, (points, num_windows, length, n_rotors)
                [N].
        """
        scene, length = self.scene, thrusts.shape[2]
        state = flight_state(start.reshape(-1, RIGID))
        if not (scene.schedules or scene.air or scene.forces):
            return read(scene, self._fly(state, thrusts, None))
        try:
            return read(scene, self._settle(state, thrusts, length))
        except (ConvergenceError, FlightError):
            if torch.is_grad_enabled():
                raise
        self._last = None  # forces that ran away are no first guess
        for end in range(_PART, length, _PART):
            self._settle(state, thrusts, end)
        return read(scene, self._settle(state, thrusts, length))

    def _settle(self, start: FlightState, thrusts: Tensor, end: int) -> SensedRecord:
        """Flights whose forces follow from the motion in the first steps; later ones keep the last.

        Where forces are strong, those of late steps run away before early ones have settled: then
        they are settled part by part.

        Args:
            start: States of all windows, (points * num_windows, ...).
            thrusts: As of ``fly_thrusts``.
            end: Number of these steps.
        """
        scene = self.scene
        flown, air = self._last or (thrusts, thrusts.new_zeros(1))
        still = 0 if torch.is_grad_enabled() else _MORE_FOR_GRADIENTS
        for _ in range(_MAX_PASSES):
            record = self._fly(start, flown, air if air.dim() > 1 else None)
            motion = record.motion(scene.vehicle, flown, thrusts, scene.dt)
            before, air_before = flown, air
            flown = _held_from(self._schedule_thrusts(motion, thrusts), end)
            air = _held_from(self._sum_air_forces(motion), end)
            with torch.no_grad():
                moved = (flown - before).abs().max(), (air - air_before).abs().max()
                change = float(torch.maximum(*moved))  # of what ran away NaN, which max() may drop
            still += change < _SETTLED
            if still > _MORE_FOR_GRADIENTS:
                if not torch.is_grad_enabled():
                    self._last = flown, air
                return record
        raise ConvergenceError(
            f"forces that depend on the motion still change by {change:.1e} N after "
            f"{_MAX_PASSES} passes; shorten the windows or reduce the effects' sizes",
            residual_norm=change,
            tolerance=_SETTLED,
            num_iters=_MAX_PASSES,
        )

    def _schedule_thrusts(self, motion: FlightMotion, thrusts: Tensor) -> Tensor:
        for change in self.scene.schedules:
            thrusts = change(motion, thrusts)
        return thrusts

    def _sum_air_forces(self, motion: FlightMotion) -> Tensor:
        total = torch.zeros_like(motion.velocity)
        for force in self.scene.air:
            total = total + force(motion)
        for place, law in self.scene.forces:
            total = total + _push_along(place, law, motion, self.scene.frames)
        return total

    def _fly(self, start: FlightState, thrusts: Tensor, air: Tensor | None) -> SensedRecord:
        """Flights under thrusts, and forces ``air`` in the world, (points, ..., 3) [N]."""
        scene, points = self.scene, self.points
        if scene.note is not None:
            scene.note(points)
        _, windows, length, rotors = thrusts.shape
        force = self._sum_world_forces(windows, length)
        force = force if air is None else force + air
        pull = force / scene.vehicle.mass[:, None, None, None]
        frame = _Frame.of(pull, scene.dt)
        flight = self._prepared.fly(
            start,
            thrusts.expand(points, -1, -1, -1).reshape(-1, length, rotors).contiguous(),
            wind=self._sum_wind(windows, length, frame),
        )
        state = flight.state

        def shaped(value: Tensor) -> Tensor:
            return value.reshape(points, windows, *value.shape[1:])

        return SensedRecord(
            shaped(state.position) + frame.way,
            shaped(state.velocity) + frame.velocity,
            shaped(state.rotation),
            shaped(state.quaternion),
            shaped(state.body_rates),
        )

    def _sum_world_forces(self, windows: int, length: int) -> Tensor:
        """(points or 1, num_windows or 1, length, 3) [N]."""
        force = self.scene.pushes
        if force.shape[1] == 1:
            return force[:, None].expand(-1, 1, length, 3)
        return windowed(torch.cat([force[:, :1], force[:, :-1]], 1), windows, length)

    def _make_effects(self) -> FlightEffects:
        """The scene's effects, one per window."""
        windows, repeated = len(self.scene.windows.measured), dict[str, Any]()
        for name, effect in self.scene.effects.present():
            values = {f.name: getattr(effect, f.name) for f in fields(effect)}
            rows = {k: v.repeat_interleave(windows, 0) for k, v in values.items() if len(v) > 1}
            repeated[name] = replace(effect, **rows)
        return FlightEffects(**repeated)

    def _sum_wind(self, windows: int, length: int, frame: _Frame) -> Tensor | None:
        """Of the accelerating frames, where anything feels it."""
        if not self._prepared.has_drag:
            return None
        wind = -0.5 * (frame.velocity[..., :-1, :] + frame.velocity[..., 1:, :])
        wind = wind.expand(self.points, windows, length, 3)
        return wind.reshape(-1, length, 3).contiguous()


def _held_from(values: Tensor, end: int) -> Tensor:
    """Values of steps, (points, num_windows, length, width), those after ``end`` steps the last of
    these."""
    if end >= values.shape[2]:
        return values
    first = values[:, :, :end]
    return torch.cat([first, first[:, :, -1:].expand(-1, -1, values.shape[2] - end, -1)], 2)


def windowed(values: Tensor, windows: int, length: int) -> Tensor:
    """(points, num_samples, width) -> (points, windows, length, width).

    The last row fills up the last window.
    """
    missing = windows * length - values.shape[1]
    padded = torch.cat([values, values[:, -1:].expand(-1, missing, -1)], 1)
    return padded.reshape(values.shape[0], windows, length, -1)


@dataclass(frozen=True, eq=False)
class _Frame:
    """The accelerating frame in which forces in the world are absent."""

    # way, velocity: since the window began, (..., length + 1, 3) [m], [m/s]
    way: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, pull: Tensor, dt: float) -> _Frame:
        """From accelerations held over each step, (..., length, 3) [m/s^2]."""
        zero = torch.zeros_like(pull[..., :1, :])
        velocity = torch.cat([zero, (dt * pull).cumsum(-2)], -2)
        steps = dt * (velocity[..., :-1, :] + 0.5 * dt * pull)
        return cls(torch.cat([zero, steps.cumsum(-2)], -2), velocity)


def _push_along(place: str, law: ForceLaw, motion: FlightMotion, frames: RecordingFrames) -> Tensor:
    """A force by its law along an axis of the recording, in the model's world."""
    axis = AXES.index(place)
    along = torch.eye(3, dtype=torch.float64)[axis]
    way, speed = (frames.in_world(v)[..., axis] for v in (motion.position, motion.velocity))
    # [m/s]: below this speed dry friction fades
    size, fades = law.size.reshape(-1, 1, 1), way.new_tensor(0.01)
    force = law.formula({"size": size, "x": way, "v": speed, "w": fades})
    return frames.in_world(force[..., None] * along)


def rotor_names(count: int) -> tuple[str, ...]:
    """Names of the rotors, whose thrusts are the commands of a flight."""
    return tuple(f"rotor_{i + 1}" for i in range(count))


def flight_grid(num_samples: int, dt: float) -> Grid:
    """Times of the commands of a flight, the first of which is held before the record starts.

    Args:
        dt: Time between two samples [s].
    """
    even = Grid.even(num_samples + 1, dt)
    return replace(even, samples=even.samples[1:], seconds=even.seconds[1:])


def amount(size: Tensor, axes: int) -> Tensor:
    """The first component, with the leading axis and ``axes`` more of one."""
    return size[..., 0].reshape(-1, *[1] * axes)


def vector(size: Tensor, width: int = 3) -> Tensor:
    """Components, (points, width), filled up with zeros."""
    rows = size.reshape(-1, size.shape[-1])
    return torch.nn.functional.pad(rows, (0, width - rows.shape[-1]))
