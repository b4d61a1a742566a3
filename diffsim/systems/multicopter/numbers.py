"""Numbers of a flight that causes add to or scale, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor

from diffsim.copter.vehicle.effects import BodyDrag, RotorDrag
from diffsim.systems.multicopter.flight import AXES, CopterFlight

Flight = TypeVar("Flight", bound=CopterFlight)
Change = Callable[[Tensor], Tensor]

_OF_VEHICLE = {"mass": "mass", "inertia": "inertia", "torque_ratio": "torque_ratios"}
_OF_SENSORS = ("position_scale", "ground_scale", "accelerometer_scale")
_ADDED = ("rotor_drag", "body_drag", "camera_delay")  # zero where nothing has set them
# Fields with a number for each axis of the recording.
_VECTORS = {
    "world_force": "world_force",
    "center_of_mass": "center_of_mass",
    "placement": "marker",
    "sensor_tilt": "imu_tilt",
    "attitude_offset": "attitude_offset",
    "body_rates_offset": "body_rates_offset",
    "accelerometer_offset": "accelerometer_offset",
}
NUMBERS = (
    *_OF_VEHICLE,
    *_OF_SENSORS,
    *_ADDED,
    *(f"{vector}_{axis}" for vector in _VECTORS for axis in AXES),
)


def change_number(flight: Flight, name: str, change: Change) -> Flight:
    """A copy of a flight in which a number is f(number).

    Args:
        flight: Flight that has the number.
        name: One of ``NUMBERS``.
        change: Function of the number, whose last axis is that of the points.
    """
    if name in _OF_VEHICLE:
        field = _OF_VEHICLE[name]
        value = _change_points(getattr(flight.vehicle, field), change)
        return flight.changed(vehicle=flight.vehicle.replace(**{field: value}))
    if name in _OF_SENSORS:
        return flight.changed(**{name: change(getattr(flight, name))})
    if name == "camera_delay":
        delay = flight.camera_delay
        return flight.changed(camera_delay=change(_make_zero() if delay is None else delay))
    if name in _ADDED:
        return _change_drag(flight, name, change)
    vector, axis = name.rsplit("_", 1)
    return _change_component(flight, vector, axis, change)


def _make_zero() -> Tensor:
    return torch.zeros(1, dtype=torch.float64)


def _change_points(value: Tensor, change: Change) -> Tensor:
    """A number (points, ...) changed by a function that has the points last."""
    return change(value.movedim(0, -1)).movedim(-1, 0)


def _change_drag(flight: Flight, name: str, change: Change) -> Flight:
    """The drag of the rotors, or that of the body across its z axis."""
    there = flight.flight_effects
    if name == "rotor_drag":
        rotors = there.rotor_drag
        coefficient = change(_make_zero() if rotors is None else rotors.coefficient)
        drags = replace(there, rotor_drag=RotorDrag(coefficient=coefficient))
    else:
        none = _make_zero().expand(1, 3)
        body = there.body_drag or BodyDrag(linear=none, quadratic=none)
        x, y, z = (body.linear[..., i] for i in range(3))
        drags = replace(there, body_drag=replace(body, linear=_stack_axes(change(x), change(y), z)))
    return flight.changed(flight_effects=drags)


def _change_component(flight: Flight, vector: str, axis: str, change: Change) -> Flight:
    """One component of a vector, along the axes of the recording."""
    field, frames = _VECTORS[vector], flight.frames
    turns = {"world_force": frames.in_world, "marker": frames.in_body, "imu_tilt": frames.in_body}
    turn = turns.get(field, lambda values: values)
    before = turn(getattr(flight, field))
    parts = list(before.unbind(-1))
    place = AXES.index(axis)
    parts[place] = _change_points(parts[place], change)
    after = _stack_axes(*parts)
    changed = flight.changed(**{field: turn(after)})
    if field != "center_of_mass":
        return changed
    shift = frames.in_body(after - before)[:, None]
    vehicle = flight.vehicle
    return changed.changed(vehicle=vehicle.replace(positions=vehicle.positions - shift))


def _stack_axes(*parts: Tensor) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*parts), -1)


__all__ = ["NUMBERS", "change_number"]
