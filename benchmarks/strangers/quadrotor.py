"""A quadrotor under a cascaded controller: motion capture, gyro and the motors' speeds.

NumPy alone: quadratic thrust, linear drag, motors of first order, Runge-Kutta with 2 ms.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
HIDDEN = "the propeller of rotor 3 gives 7 % less thrust and takes 7 % less torque"
MASS, INERTIA, GRAVITY = 1.12, np.array([0.0121, 0.0118, 0.0223]), 9.81
ARM = 0.17 * np.array([[1, 1], [-1, -1], [-1, 1], [1, -1]]) / np.sqrt(2.0)
SPIN = np.array([1.0, 1.0, -1.0, -1.0])  # ccw, ccw, cw, cw
THRUST, TORQUE, LAG, DRAG = 1.35e-5, 1.9e-7, 0.03, 0.12
STEP, SECONDS, EVERY = 0.002, 6.0, 5
WEAK = np.array([1.0, 1.0, 0.93, 1.0])
GOALS = {
    "circle": lambda t: (np.sin(1.5 * t), 1.0 - np.cos(1.5 * t), 1.0 + 0.3 * np.sin(t)),
    "climb": lambda t: (0.5 * np.sin(t), 0.3 * t, 1.0 + 1.2 * np.sin(1.2 * t)),
    "eight": lambda t: (1.2 * np.sin(2 * t), 0.8 * np.sin(4 * t), 1.0 + 0.2 * np.sin(3 * t)),
    "steps": lambda t: (float(t % 3 < 1.5), 0.8 * (t % 2 < 1), 1.0 + 0.5 * (t % 4 < 2)),
}
MIX = np.linalg.inv(
    np.stack([np.full(4, THRUST), THRUST * ARM[:, 1], -THRUST * ARM[:, 0], -TORQUE * SPIN])
)


def make(folder: Path, rng: np.random.Generator, torque: Array = WEAK) -> None:
    """Write the flights; ``torque`` is the share of each rotor's reaction torque."""
    header = "time,px,py,pz,qw,qx,qy,qz,gx,gy,gz,rpm1,rpm2,rpm3,rpm4"
    for name, goal in GOALS.items():
        rows = _flight(goal, torque)
        sd = np.concatenate([[0.0], np.full(3, 0.002), np.full(4, 1e-3), np.full(3, 0.4)])
        rows[:, :11] += sd * rng.normal(size=(len(rows), 11))
        np.savetxt(folder / f"{name}.csv", rows, "%.6f", ",", header=header, comments="")


def _flight(goal, torque: Array) -> Array:
    hover = np.full(4, np.sqrt(MASS * GRAVITY / 4.0 / THRUST))
    state = np.concatenate([[0, 0, 1], np.zeros(3), [1, 0, 0, 0], np.zeros(3), hover])
    rows = []
    for k in range(int(SECONDS / STEP)):
        if k % EVERY == 0:
            speeds = _controlled(state, np.array(goal(k * STEP)))
            attitude = state[6:10] / np.linalg.norm(state[6:10])
            rates, rpm = np.rad2deg(state[10:13]), speeds * 30.0 / np.pi
            rows.append(np.concatenate([[k * STEP], state[:3], attitude, rates, rpm]))
        k1 = _rates(state, speeds, torque)
        k2 = _rates(state + STEP / 2 * k1, speeds, torque)
        k3 = _rates(state + STEP / 2 * k2, speeds, torque)
        k4 = _rates(state + STEP * k3, speeds, torque)
        state = state + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return np.array(rows)


def _rates(state: Array, command: Array, torque: Array) -> Array:
    v, q, w, speed = state[3:6], state[6:10], state[10:13], state[13:]
    R, lift = _rotation(q), THRUST * speed**2 * WEAK
    force = R @ np.array([0.0, 0.0, lift.sum()]) - DRAG * v - np.array([0.0, 0.0, MASS * GRAVITY])
    yaw = -(SPIN * TORQUE * speed**2 * torque).sum()
    moment = np.array([(ARM[:, 1] * lift).sum(), -(ARM[:, 0] * lift).sum(), yaw])
    turned = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
    spun = (moment - np.cross(w, INERTIA * w)) / INERTIA
    return np.concatenate([v, force / MASS, turned, spun, (command - speed) / LAG])


def _controlled(state: Array, goal: Array) -> Array:
    R = _rotation(state[6:10])
    pull = np.clip(3.0 * (goal - state[:3]) - 3.0 * state[3:6], -4.0, 4.0)
    wanted = pull + np.array([0.0, 0.0, GRAVITY])
    lean, w = R.T @ wanted / np.linalg.norm(wanted), state[10:13]
    yaw = np.arctan2(R[1, 0], R[0, 0])
    bend = (-90.0 * lean[1] - 16.0 * w[0], 90.0 * lean[0] - 16.0 * w[1], -4.0 * yaw - 6.0 * w[2])
    squared = MIX @ np.array([MASS * wanted @ R[:, 2], *(INERTIA * bend)])
    return np.sqrt(np.clip(squared, 250.0**2, 900.0**2))


def _rotation(q: Array) -> Array:
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
