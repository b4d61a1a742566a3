"""What may differ from one copter's episode to the next, and the vehicles that this makes.

And commands that come late, kept in a queue.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from diffsim.copter import Battery, Fleet, FlightEffects, Multicopter, rotor_model
from diffsim.copter.vehicle.effects import BatterySag
from diffsim.envs.task import Randomization, Randomizing

PACKED = ("mass", "inertia", "drag", "motor_lag")  # factors that are parameters of the kernel


def randomizable(battery: Battery | None, randomization: Randomizing) -> tuple[str, ...]:
    """Names that a randomization of a copter may have.

    Args:
        battery: Of the task; without one there is no charge to be drawn.
        randomization: Of the task; a battery's factors are charges.

    Raises:
        ValueError: a battery's charge above 1.
    """
    if battery is None:
        return ("thrust", *PACKED)
    given = randomization.factors if isinstance(randomization, Randomization) else randomization
    low, high = (given or {}).get("battery", (1.0, 1.0))
    if high > 1.0:
        raise ValueError(
            "randomization['battery'] is the charge at the start and must be at most 1, got "
            f"({low:g}, {high:g})"
        )
    return ("thrust", *PACKED, "battery")


def sag_of(battery: Battery, vehicle: Multicopter) -> BatterySag:
    """What a battery does under a vehicle's rotors.

    Raises:
        ValueError: the vehicle does not say which rotors it has.
    """
    if not vehicle.rotor_models:
        raise ValueError(
            "battery needs the currents of the rotors, but the vehicle's rotor_models is empty; "
            "name one model per rotor (diffsim.copter.rotor_names() lists them)"
        )
    return battery.sag([rotor_model(name) for name in vehicle.rotor_models])


def with_factors(
    vehicle: Multicopter | Fleet, effects: FlightEffects, factors: Mapping[str, Tensor]
) -> tuple[Multicopter | Fleet, FlightEffects]:
    """One vehicle per member of a batch.

    Args:
        vehicle: The nominal one, or one per member.
        effects: With motor lag and body drag.
        factors: Factors (batch,) on some of ``PACKED``, by name.

    Returns:
        Vehicles and effects as ``prepare_flight`` takes them, leading axis (batch or 1,).
    """
    if not factors:
        return vehicle, effects
    fleet = vehicle if isinstance(vehicle, Fleet) else Fleet.of([vehicle])
    if "mass" in factors:
        fleet = fleet.replace(mass=fleet.mass * factors["mass"])
    if "inertia" in factors:
        fleet = fleet.replace(inertia=fleet.inertia * factors["inertia"][:, None, None])
    drag, lag = effects.body_drag, effects.motor_lag
    assert drag is not None and lag is not None  # of the copters' tasks
    if "drag" in factors:
        f = factors["drag"][:, None]
        drag = dataclasses.replace(drag, linear=drag.linear * f, quadratic=drag.quadratic * f)
    if "motor_lag" in factors:
        slower = lag.time_constants * factors["motor_lag"][:, None]
        lag = dataclasses.replace(lag, time_constants=slower)
    return fleet, dataclasses.replace(effects, body_drag=drag, motor_lag=lag)


def queue_length(delay: float, dt: float) -> int:
    """Commands to be kept for a delay [s] with steps of dt [s]."""
    return int(np.ceil(delay / dt - 1e-9)) + 1


def delayed(queue: Tensor, asked: Tensor, steps: Tensor) -> tuple[Tensor, Tensor]:
    """What acts over a step, in the mean, when commands come late; and the commands kept.

    Args:
        queue: Commands of the steps before, the oldest first, (batch, length, width).
        asked: Command of this step, (batch, width).
        steps: Delay in steps, at most length, (batch or 1,).
    """
    kept = torch.cat([queue, asked[:, None]], 1)
    ages = torch.arange(kept.shape[1] - 1, -1, -1, dtype=steps.dtype)
    # a command held over its step and late by 2.3 steps: 0.7 of that two steps ago, 0.3 of three
    shares = (1.0 - (ages - steps[:, None]).abs()).clamp(min=0.0)
    return (shares[..., None] * kept).sum(1), kept[:, 1:]
