"""First guesses of the initial states of windows, from whatever was recorded."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY
from diffsim.core.rotation import matrix_from_quaternion, matrix_from_rpy, rpy_from_matrix
from diffsim.systems.multicopter.frames import RecordingFrames
from diffsim.systems.multicopter.shooting import guess_states, slope

_DOWN = torch.tensor([0.0, 0.0, GRAVITY], dtype=torch.float64)


def states_of(groups: Mapping[str, Tensor], frames: RecordingFrames, dt: float) -> Tensor:
    """States of 12 at every sample, (num_samples, 12), in the model's frames.

    Velocity that was not recorded is the slope of the position, body rates are those of the
    attitude. Roll and pitch that were not recorded follow from the direction of the thrust: that of
    the acceleration less gravity.

    Args:
        groups: Readings by group, keys of ``SENSORS``, (num_samples, 3 or 4) each in the
            recording's frames; columns without any reading are NaN, gaps are filled.
        dt: Time between two samples [s].
    """
    position, velocity = _find_path(groups, frames, dt)
    rates = groups.get("body_rates")
    if rates is not None:
        rates = None if bool(rates.isnan().any()) else frames.in_body(rates)
    rpy = _find_attitude(groups, frames, velocity, dt)
    states = guess_states(position, rpy, rates, dt)
    states[:, 6:9] = velocity
    return states


def acceleration_of(
    groups: Mapping[str, Tensor], frames: RecordingFrames, states: Tensor, dt: float
) -> Tensor:
    """Acceleration of the vehicle at every sample, (num_samples, 3), world frame of the model.

    By the accelerometer, if there is one, else the slope of the velocity.

    Args:
        groups: Readings by group, as of ``states_of``.
        states: States of 12 at every sample, (num_samples, 12).
        dt: Time between two samples [s].
    """
    specific = groups.get("accelerometer")
    if specific is not None and not bool(specific.isnan().any()):
        rotation = matrix_from_rpy(states[:, 3:6])
        found = (rotation * frames.in_body(specific)[:, None]).sum(-1)
    else:
        found = _find_thrust_acceleration(groups, frames, states[:, 6:9], dt)
    return found + _DOWN


def _find_path(
    groups: Mapping[str, Tensor], frames: RecordingFrames, dt: float
) -> tuple[Tensor, Tensor]:
    """Position and velocity, (num_samples, 3) each."""
    place, speed = groups.get("position"), groups.get("velocity")
    if place is None:
        if speed is None:
            raise ValueError("flights need a recorded position or velocity, got neither")
        speed = frames.in_world(speed.nan_to_num(0.0))
        return dt * speed.cumsum(0), speed
    place = place.nan_to_num(0.0)
    shown = slope(place, dt)
    if speed is not None:
        shown = torch.where(speed.isnan(), shown, speed)
    return frames.in_world(place), frames.in_world(shown)


def _find_attitude(
    groups: Mapping[str, Tensor], frames: RecordingFrames, velocity: Tensor, dt: float
) -> Tensor:
    """Roll, pitch and yaw without jumps, (num_samples, 3)."""
    quaternion, rpy = groups.get("quaternion"), groups.get("attitude")
    if quaternion is not None and not bool(quaternion.isnan().any()):
        unit = quaternion / quaternion.norm(dim=-1, keepdim=True).clamp(min=1e-12)
        rotation = frames.rotation(matrix_from_quaternion(unit))
    elif rpy is not None and not bool(rpy.isnan().any()):
        if frames == RecordingFrames():
            return rpy
        rotation = frames.rotation(matrix_from_rpy(rpy))
    else:
        rotation = _find_rotation_by_thrust(
            _find_thrust_acceleration(groups, frames, velocity, dt), rpy, frames
        )
    angles = rpy_from_matrix(rotation).numpy()
    return torch.from_numpy(np.unwrap(angles, axis=0))


def _find_thrust_acceleration(
    groups: Mapping[str, Tensor], frames: RecordingFrames, velocity: Tensor, dt: float
) -> Tensor:
    """Force over mass besides gravity, world frame of the model, (num_samples, 3) [m/s^2]."""
    for name, gravity in (("acceleration", _DOWN), ("specific_force_in_world", 0.0 * _DOWN)):
        given = groups.get(name)
        if given is not None and not bool(given.isnan().any()):
            return frames.in_world(given) - gravity
    return slope(velocity, dt) - _DOWN


def _find_rotation_by_thrust(thrust: Tensor, rpy: Tensor | None, frames: RecordingFrames) -> Tensor:
    """World from body of the model, (num_samples, 3, 3): what was recorded of roll, pitch and yaw,
    the rest by the direction of the thrust."""
    known = torch.full_like(thrust, torch.nan) if rpy is None else rpy
    heading = torch.zeros_like(thrust)
    heading[:, 2] = known[:, 2].nan_to_num(0.0)
    yaw = rpy_from_matrix(frames.rotation(matrix_from_rpy(heading)))[:, 2]
    x, y, z = (-thrust / thrust.norm(dim=-1, keepdim=True).clamp(min=1e-6)).unbind(-1)
    ahead, right = yaw.cos() * x + yaw.sin() * y, yaw.cos() * y - yaw.sin() * x
    # the body's z axis at this heading is (sin p cos r, -sin r, cos p cos r)
    angles = torch.stack([-right.clamp(-1.0, 1.0).asin(), torch.atan2(ahead, z), yaw], -1)
    shown = rpy_from_matrix(frames.rotation(matrix_from_rpy(angles)))
    shown = torch.where(known.isnan(), shown, known)
    return frames.rotation(matrix_from_rpy(shown))
