"""Flights: batched, differentiable rollouts of multicopters, open or closed loop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.copter import _ops_flight
from diffsim.copter._ops_flight import FlightInputs, FlightSettings
from diffsim.copter.effects import FlightEffects
from diffsim.copter.fleet import Fleet
from diffsim.copter.flight_state import FlightState
from diffsim.copter.vehicle import GRAVITY, Multicopter
from diffsim.core.check import require, require_number, values_of
from diffsim.core.errors import DiffsimError

_NAMES = {"feed_forward": "commands"}  # what callers know an input as
_NEUTRAL = {"curve_reference": 1.0, "nominal_voltage": 1.0}  # the others are zero where absent


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


@dataclass(frozen=True, eq=False)
class Flight:
    """What a rollout returns.

    Attributes:
        state: State of every vehicle at every control step and at the end, axes (batch, steps + 1,
            ...).
        time: (steps + 1,) [s].
    """

    state: FlightState
    time: Tensor


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
        num_threads: Threads of the kernel; the result does not depend on it.

    Returns:
        The states at the start and after each control period.

    Raises:
        TypeError, ValueError: bad arguments.
        FlightError: a state is no longer finite, or a battery is empty.

    Gradients: start, commands, gain, reference, every tensor of vehicle and effects; first order.
    """
    dt = require_number("dt", dt, above=0.0)
    for name, count in (("substeps", substeps), ("num_threads", num_threads)):
        if count != int(count) or count < 1:
            raise ValueError(f"{name} must be a whole number >= 1, got {count}")
    effects = FlightEffects() if effects is None else effects
    present = [name for name, _ in effects.present()]
    if not clamp and (powers := sorted({"thrust_curve", "battery"} & set(present))):
        raise ValueError(
            f"clamp=False lets thrusts be negative, of which effects.{powers[0]} takes a power; "
            "leave one of them out"
        )
    fleet = vehicle if isinstance(vehicle, Fleet) else _fleet(vehicle)
    n = fleet.num_rotors
    require("commands", commands, ("batch", "steps", n))
    steps = commands.shape[1]
    gain = reference = commands.new_empty(0, 0, 0)
    if feedback is not None:
        gain = require("gain", feedback.gain, ("...", n, 12)).reshape(-1, 1, 12 * n)
        reference = _rows(feedback.reference)
    inputs = FlightInputs(
        start=_start_rows(start, commands),
        feed_forward=commands,
        gain=gain,
        reference=reference,
        wind=commands.new_zeros(1, 1, 3) if effects.wind is None else _rows(effects.wind),
        parameters=_parameters(fleet, effects, dt / substeps),
    )
    lengths = {
        "wind": inputs.wind.shape[1],
        "reference": reference.shape[1],
        "commands": steps,
    }
    batch = _common("batch", {_NAMES.get(k, k): v.shape[0] for k, v in inputs._asdict().items()})
    _common("steps", lengths)
    settings = FlightSettings(
        dt=dt / substeps,
        gravity=GRAVITY,
        substeps=substeps,
        effects=",".join(present if clamp else [*present, "free_thrusts"]),
        num_threads=num_threads,
    )
    records = _ops_flight.rollout(inputs, settings, batch=batch, steps=steps)
    _require_airborne(records.detach(), effects)
    position, quaternion, velocity, rates, charge, thrusts = records.split([3, 4, 3, 3, 1, n], -1)
    state = FlightState(position, quaternion, velocity, rates, thrusts, charge[..., 0])
    return Flight(state, dt * torch.arange(steps + 1, dtype=torch.float64))


def _fleet(vehicle: Multicopter | Sequence[Multicopter]) -> Fleet:
    vehicles = [vehicle] if isinstance(vehicle, Multicopter) else list(vehicle)
    counts = sorted({v.num_rotors for v in vehicles})
    if len(counts) != 1:
        raise ValueError(f"vehicles of one flight need equal rotor counts, got {counts}")
    if counts[0] > _ops_flight.MAX_ROTORS:
        raise ValueError(f"flights take up to {_ops_flight.MAX_ROTORS} rotors, got {counts[0]}")
    return Fleet.of(vehicles)


def _common(what: str, sizes: dict[str, int]) -> int:
    """The size that all share but for those that are one (or absent: zero)."""
    many = {name: size for name, size in sizes.items() if size > 1}
    if len(set(many.values())) > 1:
        listed = ", ".join(f"{name} {size}" for name, size in many.items())
        raise ValueError(f"{what} sizes disagree: {listed}; each must be one of them or 1")
    return max([1, *many.values()])


def _rows(value: Tensor) -> Tensor:
    """(width,), (steps, width) or (batch, steps, width) as the last."""
    return value.reshape((1,) * (3 - value.dim()) + value.shape)


def _start_rows(start: FlightState, commands: Tensor) -> Tensor:
    require("start.position", start.position, ("batch", 3))
    norm = start.quaternion.norm(dim=-1, keepdim=True)
    if not torch.compiler.is_compiling() and bool((norm.detach() < 1e-6).any()):
        raise ValueError("start.quaternion must not be zero; (1, 0, 0, 0) is level, heading north")
    charge = (
        start.position.new_ones(start.position.shape[0]) if start.charge is None else start.charge
    )
    thrusts = commands[:, 0] if start.thrusts is None else start.thrusts
    if commands.shape[1] == 0 and start.thrusts is None:
        raise ValueError("commands has no steps; give at least one, or start.thrusts")
    parts = [
        start.position,
        start.quaternion / norm,
        start.velocity,
        start.body_rates,
        charge[:, None],
        thrusts,
    ]
    batch = _common("batch", {"start": start.position.shape[0], "commands": thrusts.shape[0]})
    row = torch.cat([p.expand(batch, -1) for p in parts], dim=-1)
    return require("start", row, ("batch", row.shape[1]))[:, None]


def _parameters(fleet: Fleet, effects: FlightEffects, dt: float) -> Tensor:
    """Rows of the kernel's parameters, (batch or 1, 1, size)."""
    n = fleet.num_rotors
    values = fleet.rows()
    for _, effect in effects.present():
        values |= effect.row(dt)
    pieces = []
    for name, size in _ops_flight.fields(n):
        value = values.get(name)
        if value is None:
            value = torch.full((1, size), _NEUTRAL.get(name, 0.0), dtype=torch.float64)
        if value.numel() % size:
            raise ValueError(f"{name} needs {size} values per vehicle, got {tuple(value.shape)}")
        pieces.append(value.reshape(-1, size))
    batch = _common(
        "vehicle and effects",
        {
            name: piece.shape[0]
            for (name, _), piece in zip(_ops_flight.fields(n), pieces, strict=True)
        },
    )
    return torch.cat([piece.expand(batch, -1) for piece in pieces], dim=-1)[:, None]


def _require_airborne(records: Tensor, effects: FlightEffects) -> None:
    if torch.compiler.is_compiling():
        return
    records = values_of(records).flatten(end_dim=-3)
    # a sum is the cheapest look at all of them
    if not math.isfinite(float(records.sum())) and bool((bad := ~torch.isfinite(records)).any()):
        vehicle, step, _ = (int(i) for i in torch.nonzero(bad)[0])
        raise FlightError(
            f"vehicle {vehicle} has no finite state after step {step}; shorten dt or raise "
            "substeps, check the gain, and keep the pitch away from +-90 degrees under feedback",
            vehicle=vehicle,
            step=step,
        )
    if effects.battery is not None:
        charge = records[..., 13]
        if bool((charge < 0.0).any()):
            vehicle, step = (int(i) for i in torch.nonzero(charge < 0.0)[0])
            raise FlightError(
                f"the battery of vehicle {vehicle} is empty after step {step}; fly for less time, "
                "or give a larger capacity",
                vehicle=vehicle,
                step=step,
            )
