"""Equations of motion in twelve states and their linearization about a hover (thesis 3.3.3)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.copter.vehicle.multicopter import GRAVITY, Multicopter
from diffsim.core.check import require, require_choice
from diffsim.core.checked import checked
from diffsim.core.module import loadable
from diffsim.core.rotation import body_rates_matrix, matrix_from_rpy, skew

FORMS = ("euler", "rotation_vector")


@loadable
class LinearModel(NamedTuple):
    """x' = A x + B u for small departures from a fixed point.

    Attributes:
        A: State matrix, (12, 12) [1/s].
        B: (12, n_rotors).
    """

    A: Tensor
    B: Tensor


@checked(state=(12,), thrusts=("n_rotors",))
def state_rate(copter: Multicopter, state: Tensor, thrusts: Tensor) -> Tensor:
    """f(x, u) of the thesis's eq. 3.6 in Euler angles, body velocity and Euler rates.

    m (v' + w x v) = m R' g + M_f u,  J w' + w x J w = M_t u,  w = E(euler) euler'.

    Args:
        copter: The vehicle.
        state: Position (NED), roll, pitch, yaw, velocity in the body frame, rates of roll, pitch
            and yaw, (12,) float64 [m, rad, m/s, rad/s].
        thrusts: u, (n_rotors,) float64 [N].

    Returns:
        The state's rate, (12,). Not defined at a pitch of 90 degrees.
    """
    euler, velocity, rates = state[3:6], state[6:9], state[9:]
    R = matrix_from_rpy(euler)
    E, E_rate = body_rates_matrix(euler), _body_rates_matrix_rate(euler, rates)
    omega = E @ rates
    gravity = R[2] * GRAVITY
    inertia = copter.inertia
    spin = copter.torque_matrix @ thrusts - torch.linalg.cross(omega, inertia @ omega)
    omega_rate = torch.linalg.solve(inertia, spin)
    acceleration = gravity + copter.force_matrix @ thrusts / copter.mass
    return torch.cat(
        [
            R @ velocity,
            rates,
            acceleration - torch.linalg.cross(omega, velocity),
            torch.linalg.solve(E, omega_rate - E_rate @ rates),
        ]
    )


def _body_rates_matrix_rate(euler: Tensor, rates: Tensor) -> Tensor:
    """Time derivative of ``body_rates_matrix``; written out, so that both modes may pass."""
    (sr, sp, _), (cr, cp, _) = euler.sin(), euler.cos()
    zero, (roll_rate, pitch_rate, _) = torch.zeros_like(sr), rates
    rows = [
        [zero, zero, -cp * pitch_rate],
        [zero, -sr * roll_rate, cp * cr * roll_rate - sp * sr * pitch_rate],
        [zero, -cr * roll_rate, -cp * sr * roll_rate - sp * cr * pitch_rate],
    ]
    return torch.stack([torch.stack(row) for row in rows])


@checked
def linearize(
    copter: Multicopter, thrusts: Tensor, attitude: Tensor, *, form: str = "euler"
) -> LinearModel:
    """A and B of the motion about a hover (thesis eq. 3.7), at rest and yaw zero.

    "euler" has the states of ``state_rate``. "rotation_vector" has position, the rotation vector
    theta of R = R_hover exp(theta), velocity in the body frame and angular velocity, regular at
    every attitude; both describe the same motion.

    Args:
        copter: The vehicle; its tensors may carry gradients.
        thrusts: Hover thrusts, (n_rotors,) float64 [N]; ``hover(copter).thrusts``.
        attitude: Roll and pitch, (2,) float64 [rad]; ``hover(copter).attitude``.
        form: "euler" or "rotation_vector".

    Returns:
        A (12, 12) and B (12, n_rotors).

    Raises:
        TypeError, ValueError: wrong types, shapes or form.

    Gradients: all tensors of the vehicle, thrusts, attitude; any order. A fixed point is assumed,
        not required: away from a hover these are still the derivatives of the motion at rest.
    """
    require_choice("form", form, FORMS)
    thrusts = require("thrusts", thrusts, (copter.num_rotors,))
    attitude = require("attitude", attitude, (2,))
    euler = torch.cat([attitude, attitude.new_zeros(1)])
    if form == "rotation_vector":
        return _about_rotation_vector(copter, euler)
    return _about_euler_angles(copter, thrusts, euler)


def _about_euler_angles(copter: Multicopter, thrusts: Tensor, euler: Tensor) -> LinearModel:
    """At rest: p' = R v, v' = R'g + M_f u / m, euler'' = E^-1 J^-1 M_t u."""
    R, E = matrix_from_rpy(euler), body_rates_matrix(euler)
    push = torch.linalg.solve(copter.inertia, copter.torque_matrix)
    none, eye = torch.zeros(3, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    A = torch.cat(
        [
            torch.cat([none, none, R, none], 1),
            torch.cat([none, none, none, eye], 1),
            torch.cat([none, _gravity_slope(euler), none, none], 1),
            torch.cat([none, _angle_acceleration_slope(euler, push @ thrusts), none, none], 1),
        ]
    )
    return _with_inputs(copter, A, torch.linalg.solve(E, push))


def _gravity_slope(euler: Tensor) -> Tensor:
    """d(R'g) / d euler, (3, 3): R'g = g (-sin p, cos p sin r, cos p cos r)."""
    (sr, sp, _), (cr, cp, _) = euler.sin(), euler.cos()
    zero = torch.zeros_like(sr)
    rows = [[zero, -cp, zero], [cp * cr, -sp * sr, zero], [-cp * sr, -sp * cr, zero]]
    return GRAVITY * torch.stack([torch.stack(row) for row in rows])


def _angle_acceleration_slope(euler: Tensor, omega_rate: Tensor) -> Tensor:
    """d(E^-1 w') / d euler at fixed w', (3, 3); zero at a hover, where w' = 0."""
    (sr, sp, _), (cr, cp, _) = euler.sin(), euler.cos()
    _, y, z = omega_rate
    across, along = sr * y + cr * z, cr * y - sr * z
    zero = torch.zeros_like(sr)
    rows = [
        [along * sp / cp, across / cp**2, zero],
        [-across, zero, zero],
        [along / cp, across * sp / cp**2, zero],
    ]
    return torch.stack([torch.stack(row) for row in rows])


def _about_rotation_vector(copter: Multicopter, euler: Tensor) -> LinearModel:
    """At rest: p' = R v, theta' = w, v' = exp(-theta) R'g + M_f u / m, w' = J^-1 M_t u."""
    R = matrix_from_rpy(euler)
    none, eye = torch.zeros(3, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)
    A = torch.cat(
        [
            torch.cat([none, none, R, none], 1),
            torch.cat([none, none, none, eye], 1),
            torch.cat([none, skew(R[2] * GRAVITY), none, none], 1),
            torch.cat([none, none, none, none], 1),
        ]
    )
    return _with_inputs(copter, A, torch.linalg.solve(copter.inertia, copter.torque_matrix))


def _with_inputs(copter: Multicopter, A: Tensor, angular: Tensor) -> LinearModel:
    still = torch.zeros(6, copter.num_rotors, dtype=torch.float64)
    return LinearModel(A, torch.cat([still, copter.force_matrix / copter.mass, angular]))
