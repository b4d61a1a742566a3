"""Flights: batched, differentiable rollouts of multicopters, open or closed loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter.dynamics import _ops_flight
from diffsim.copter.dynamics._ops_flight import FlightInputs, FlightSettings
from diffsim.copter.dynamics.flight_state import (
    FlightState,
    common_size,
    fleet_of,
    parameter_rows,
    start_rows,
    with_batch_and_steps,
)
from diffsim.copter.vehicle.effects import FlightEffects, require_wind
from diffsim.copter.vehicle.multicopter import GRAVITY, Fleet, Multicopter
from diffsim.core.check import (
    all_finite,
    require,
    require_choice,
    require_count,
    require_number,
    require_threads,
)
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.module import loadable
from diffsim.core.numbers import values_of

_NAMES = {"feed_forward": "commands"}  # what callers know an input as


class FlightError(DiffsimError):
    """A flight that cannot go on.

    Attributes:
        vehicle: Index in the batch.
        step: Control step after which it was detected.
    """

    def __init__(self, message: str, *, vehicle: int, step: int):
        super().__init__(message)
        self.vehicle = vehicle
        self.step = step


@dataclass(frozen=True, kw_only=True, eq=False)
class Feedback:
    """Linear state feedback: thrusts = commands - gain (x - reference), x the state of 12.

    Attributes:
        gain: K, (n_rotors, 12) or (batch, n_rotors, 12).
        reference: (12,), (steps, 12) or (batch or 1, steps or 1, 12); see
            ``FlightState.from_minimal``. Roll and yaw errors are taken the short way round.
    """

    gain: Tensor
    reference: Tensor

    def __post_init__(self) -> None:
        require("gain", self.gain, ("...", "n_rotors", 12))
        require("reference", self.reference, ("...", 12))


@checked(time=("steps + 1",))
@loadable
@dataclass(frozen=True, eq=False)
class Flight:
    """What a rollout returns.

    Attributes:
        state: State of every vehicle at every control step and at the end, axes (batch, steps + 1,
            ...); of a flight with ``keep="end"`` at the end alone, (batch, 1, ...).
        time: (steps + 1,) or (1,) [s].
    """

    state: FlightState
    time: Tensor


@checked
def fly(
    vehicle: Multicopter | Sequence[Multicopter] | Fleet,
    start: FlightState,
    commands: Tensor,
    *,
    dt: float,
    feedback: Feedback | None = None,
    effects: FlightEffects | None = None,
    substeps: int = 1,
    clamp: bool = True,
    keep: str = "path",
    num_threads: int = 1,
) -> Flight:
    """Fly a batch of multicopters.

    m p'' = m g + R M_f u, J w' + w x J w = M_t u (thesis eqs. 3.2-3.5) with the classical
    Runge-Kutta method of order four; the quaternion is normalized after every step. Thrusts u are
    the commands (less the feedback), clamped to 0..max_thrusts and held for ``dt``. An active clamp
    has no gradient to the command; at a bound the gradient is that of the inside.

    Args:
        vehicle: One for all, or one per member of the batch with equal rotor counts; many are
            given faster as one ``Fleet``.
        start: Leading axis (batch or 1,).
        commands: Thrusts, (batch or 1, steps, n_rotors) [N].
        dt: Control period [s].
        feedback: Makes the commands a feed-forward.
        effects: What is there besides gravity and ideal rotors.
        substeps: Integration steps per control period.
        clamp: Whether thrusts stay within 0..max_thrusts; False: they are what is commanded,
            negative ones too, for moments that are given to the vehicle through its thrusts.
        keep: "path": the states at the start and after each control period; "end": the last alone,
            which needs no memory for the others, and no time to write them. Its gradient flies
            once more.
        num_threads: Threads of the kernel; the result does not depend on it.

    Returns:
        The states that are kept.

    Raises:
        TypeError, ValueError: bad arguments.
        FlightError: a state is no longer finite, or a battery is empty.

    Gradients: start, commands, gain, reference, every tensor of vehicle and effects; first order.
    """
    prepared = prepare_flight(
        vehicle,
        dt=dt,
        effects=effects,
        substeps=substeps,
        clamp=clamp,
        num_threads=num_threads,
    )
    return prepared.fly(start, commands, feedback=feedback, keep=keep)


@dataclass(frozen=True, kw_only=True, eq=False)
class PreparedFlight:
    """Vehicles and effects as the kernel reads them, for many flights; see ``prepare_flight``.

    Attributes:
        parameters: Row of every vehicle, (batch or 1, 1, size); carries the gradients of vehicle
            and effects. Changes of their tensors in place come too late.
        num_rotors: Rotors of every vehicle.
        dt: Control period [s].
        wind: Of the effects; a flight may be given another one.
        settings: How the kernel integrates.
        has_battery, has_drag: Whether the effects have a battery, and a drag to feel wind by.
    """

    parameters: Tensor
    num_rotors: int
    dt: float
    wind: Tensor | None
    settings: FlightSettings
    has_battery: bool
    has_drag: bool

    @checked
    def fly(
        self,
        start: FlightState,
        commands: Tensor,
        *,
        feedback: Feedback | None = None,
        wind: Tensor | None = None,
        keep: str = "path",
    ) -> Flight:
        """A flight; the same as the function ``fly``.

        Args:
            start, commands, feedback, keep: As of ``fly``.
            wind: As of ``FlightEffects``; the prepared one by default.
        """
        end_alone = require_choice("keep", keep, ("path", "end")) == "end"
        records = self._records(start, commands, feedback, wind, end_alone)
        steps = commands.shape[1]
        first = steps if end_alone else 0
        time = self.dt * torch.arange(first, steps + 1, dtype=torch.float64)
        return Flight(self._state(records), time)

    @checked
    def step(
        self, start: FlightState, thrusts: Tensor, *, wind: Tensor | None = None
    ) -> FlightState:
        """One control period: where the vehicles are at its end.

        Args:
            start: Leading axis (batch or 1,).
            thrusts: Commands, (batch or 1, n_rotors) [N].
            wind: World frame, (3,) or (batch or 1, 3) [m/s]; the prepared one by default.

        Returns:
            The state, leading axis (batch,).

        Raises:
            As ``fly``. Gradients: as ``fly``.
        """
        require("thrusts", thrusts, ("batch", self.num_rotors), finite=False)
        gust = None if wind is None else wind[..., None, :]
        return self._state(self._records(start, thrusts[:, None], None, gust, False)[:, 1])

    def _records(
        self,
        start: FlightState,
        commands: Tensor,
        feedback: Feedback | None,
        wind: Tensor | None,
        end_alone: bool,
    ) -> Tensor:
        n = self.num_rotors
        require("commands", commands, ("batch", "steps", n))
        gain = reference = commands.new_empty(0, 0, 0)
        if feedback is not None:
            gain = require("gain", feedback.gain, ("...", n, 12)).reshape(-1, 1, 12 * n)
            reference = with_batch_and_steps(feedback.reference)
        inputs = FlightInputs(
            start=start_rows(start, commands),
            feed_forward=commands,
            gain=gain,
            reference=reference,
            wind=self._wind_rows(wind, commands),
            parameters=self.parameters,
        )
        names = {_NAMES.get(name, name): rows for name, rows in inputs._asdict().items()}
        batch = common_size("batch", {name: rows.shape[0] for name, rows in names.items()})
        timed = ("wind", "reference", "commands")
        common_size("steps", {name: names[name].shape[1] for name in timed})
        steps = commands.shape[1]
        sizes = {"batch": batch, "steps": steps}
        records = _ops_flight.rollout(inputs, self.settings, **sizes, end_alone=end_alone)
        if not _is_airborne(records.detach()[..., -1, :], self.has_battery):
            path = records
            if end_alone:
                path = _ops_flight.rollout(inputs, self.settings, **sizes, end_alone=False)
            raise _failure(values_of(path).flatten(end_dim=-3))
        return records

    def _wind_rows(self, wind: Tensor | None, commands: Tensor) -> Tensor:
        if wind is None:
            if self.wind is None:
                return commands.new_zeros(1, 1, 3)
            return with_batch_and_steps(self.wind)
        require_wind(wind, self.has_drag)
        return with_batch_and_steps(wind)

    def _state(self, records: Tensor) -> FlightState:
        widths = [3, 4, 3, 3, 1, self.num_rotors]
        position, quaternion, velocity, rates, charge, thrusts = records.split_with_sizes(
            widths, -1
        )
        return FlightState(position, quaternion, velocity, rates, thrusts, charge[..., 0])


@checked
def prepare_flight(
    vehicle: Multicopter | Sequence[Multicopter] | Fleet,
    *,
    dt: float,
    effects: FlightEffects | None = None,
    substeps: int = 1,
    clamp: bool = True,
    num_threads: int = 1,
) -> PreparedFlight:
    """Pack vehicles and effects once, for flights that are called step by step.

    Args:
        vehicle, dt, effects, substeps, clamp, num_threads: As of ``fly``.

    Returns:
        What flies them, with the same results and gradients as ``fly``. If a tensor of vehicle or
        effects carries gradients, one backward pass frees the history; prepare anew after it.

    Raises:
        TypeError, ValueError: bad arguments.
    """
    dt = require_number("dt", dt, above=0.0)
    substeps = require_count("substeps", substeps, at_least=1)
    num_threads = require_threads(num_threads)
    effects = FlightEffects() if effects is None else effects
    present = [name for name, _ in effects.present()]
    if not clamp and (powers := sorted({"thrust_curve", "battery"} & set(present))):
        raise ValueError(
            f"clamp=False lets thrusts be negative, of which effects.{powers[0]} takes a power; "
            "leave one of them out"
        )
    fleet = vehicle if isinstance(vehicle, Fleet) else fleet_of(vehicle)
    return PreparedFlight(
        parameters=parameter_rows(fleet, effects, dt / substeps),
        num_rotors=fleet.num_rotors,
        dt=dt,
        wind=effects.wind,
        settings=FlightSettings(
            dt=dt / substeps,
            gravity=GRAVITY,
            substeps=substeps,
            effects=",".join(present if clamp else [*present, "free_thrusts"]),
            num_threads=num_threads,
        ),
        has_battery=effects.battery is not None,
        has_drag=effects.has_drag,
    )


def _is_airborne(ends: Tensor, has_battery: bool) -> bool:
    """Whether the last states are numbers, and charge is left: what is lost does not come back."""
    if torch.compiler.is_compiling():
        return True
    ends = values_of(ends)
    return all_finite(ends) and not (has_battery and bool((ends[..., 13] < 0.0).any()))


def _failure(records: Tensor) -> FlightError:
    """What went wrong first in (batch, steps + 1, ...) records, one of which did."""
    broken = torch.nonzero(~torch.isfinite(records))
    if len(broken):
        vehicle, step, _ = (int(i) for i in broken[0])
        return FlightError(
            f"vehicle {vehicle} has no finite state after step {step}; shorten dt or raise "
            "substeps, check the gain, and keep the pitch away from +-90 degrees under feedback",
            vehicle=vehicle,
            step=step,
        )
    vehicle, step = (int(i) for i in torch.nonzero(records[..., 13] < 0.0)[0])
    return FlightError(
        f"the battery of vehicle {vehicle} is empty after step {step}; fly for less time, "
        "or give a larger capacity",
        vehicle=vehicle,
        step=step,
    )
