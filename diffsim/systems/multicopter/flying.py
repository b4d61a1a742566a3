"""Windows of a flight by the flight kernel, and what sensors read in them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from diffsim.copter import FlightEffects, FlightError, prepare_flight
from diffsim.core.errors import ConvergenceError
from diffsim.systems.multicopter.flight import CopterFlight
from diffsim.systems.multicopter.motion import FlightMotion
from diffsim.systems.multicopter.readings import SensedRecord, read
from diffsim.systems.multicopter.shooting import RIGID, flight_state

_MAX_PASSES = 40  # over causes that depend on the motion
_SETTLED = 1e-8  # change of forces from pass to pass [N]
_PART = 5  # steps that settle together where whole windows do not
_MORE_FOR_GRADIENTS = 2  # passes: derivatives settle after the values


class Flyer:
    """Flies all windows of a scene at all its points; keeps the last forces.

    Forces follow from the motion, and it from them: repeated until they stay. Without gradients the
    last forces are the first guess of the next flight. (With them they must not be: values would
    settle at once, but derivatives would not.)

    A force in the world is exact without a term of its own in the dynamics: seen from a frame that
    accelerates with a = F / m it is absent, and the drags act on a wind, less the frame's velocity.

    Args:
        scene: Run to be flown.
        points: Number of points that the scene's leading axes stand for.
        is_one: Whether they are one point of the parameters, flown from many starts.
    """

    def __init__(self, scene: CopterFlight, points: int, *, is_one: bool = False):
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
        """Thrusts as of ``CopterFlight.delivered``; those of equal starts once."""
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
        if not scene.schedules and not scene.air:
            return read(scene, self._fly(start, thrusts, None))
        try:
            return read(scene, self._settle(start, thrusts, length))
        except (ConvergenceError, FlightError):
            if torch.is_grad_enabled():
                raise
        self._last = None  # forces that ran away are no first guess
        for end in range(_PART, length, _PART):
            self._settle(start, thrusts, end)
        return read(scene, self._settle(start, thrusts, length))

    def _settle(self, start: Tensor, thrusts: Tensor, end: int) -> SensedRecord:
        """Flights whose forces follow from the motion in the first steps; later ones keep the last.

        Where forces are strong, those of late steps run away before early ones have settled: then
        they are settled part by part.

        Args:
            start, thrusts: As of ``fly_thrusts``.
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
        return total

    def _fly(self, start: Tensor, thrusts: Tensor, air: Tensor | None) -> SensedRecord:
        """Flights under thrusts, and forces ``air`` in the world, (points, ..., 3) [N]."""
        scene, points = self.scene, self.points
        _, windows, length, rotors = thrusts.shape
        force = self._sum_world_forces(windows, length)
        force = force if air is None else force + air
        pull = force / scene.vehicle.mass[:, None, None, None]
        frame = _Frame.of(pull, scene.dt)
        flight = self._prepared.fly(
            flight_state(start.reshape(-1, RIGID)),
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
        force = self.scene.world_force
        if force.shape[1] == 1:
            return force[:, None].expand(-1, 1, length, 3)
        return windowed(torch.cat([force[:, :1], force[:, :-1]], 1), windows, length)

    def _make_effects(self) -> FlightEffects:
        """The scene's effects, one per window."""
        windows, repeated = len(self.scene.windows.measured), dict[str, Any]()
        for name, effect in self.scene.flight_effects.present():
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
    """The accelerating frame in which forces in the world are absent.

    Attributes:
        way, velocity: Since the window began, (..., length + 1, 3) [m], [m/s].
    """

    way: Tensor
    velocity: Tensor

    @classmethod
    def of(cls, pull: Tensor, dt: float) -> _Frame:
        """From accelerations held over each step, (..., length, 3) [m/s^2]."""
        zero = torch.zeros_like(pull[..., :1, :])
        velocity = torch.cat([zero, (dt * pull).cumsum(-2)], -2)
        steps = dt * (velocity[..., :-1, :] + 0.5 * dt * pull)
        return cls(torch.cat([zero, steps.cumsum(-2)], -2), velocity)
