"""A quadrotor without a fault: motion capture and autopilot log by themselves (SciPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

HIDDEN = "nothing"
GRAVITY, MASS, ARM, FULL, TORQUE_RATIO, LAG = 9.81, 1.352, 0.17, 8.3, 0.0141, 0.036
INERTIA = np.array([0.0118, 0.0127, 0.0205])
ANGLES = np.deg2rad([45.0, 135.0, 225.0, 315.0])  # from ahead, counterclockwise
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])  # +1: counterclockwise from above
PLACES = ARM * np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)
MIX = np.stack([np.ones(4), PLACES[:, 1], -PLACES[:, 0], -TORQUE_RATIO * SPIN])
STEP, SECONDS, EVERY = 0.001, 8.0, 10
PATHS = {
    "lawn": lambda t: (1.5 * np.sin(0.8 * t), 0.4 * t - 1.0, 1.5, 0.0),
    "tower": lambda t: (0.8 * np.cos(1.2 * t), 0.8 * np.sin(1.2 * t), 1.0 + 0.12 * t, 0.3 * t),
    "wave": lambda t: (0.5 * np.sin(1.7 * t), 0.9 * np.sin(1.1 * t), 1.4 + 0.3 * np.sin(1.5 * t),
                       0.5 * np.sin(0.9 * t)),
    "dash": lambda t: (1.4 * (t % 4.0 < 2.0), 0.6 * (t % 3.0 < 1.5), 1.3, 0.0),
}  # fmt: skip


def make(folder: Path, rng: np.random.Generator) -> None:
    """North, east, down; the autopilot's clock counts microseconds since it was switched on."""
    for name, path in PATHS.items():
        flown = _flown(path)
        time = flown[:, 0]
        place = np.array([1.0, -1.0, -1.0]) * flown[:, 1:4]
        place += rng.normal(0.0, 8e-4, place.shape)
        angles = np.rad2deg(flown[:, 4:7]) * [1.0, -1.0, -1.0]
        angles += rng.normal(0.0, 0.12, angles.shape)
        table = np.column_stack([time, place, angles])[40:]
        head = "time_s,north_m,east_m,down_m,roll_deg,pitch_deg,yaw_deg"
        np.savetxt(folder / f"{name}_vicon.csv", table, "%.5f", ",", header=head, comments="")
        rates = flown[:, 7:10] * [1.0, -1.0, -1.0] + rng.normal(0.0, 0.006, (len(time), 3))
        esc = 1000.0 + 1000.0 * flown[:, 10:]
        table = np.column_stack([1e6 * time, rates, esc])
        head = "timestamp_us,p (rad/s),q (rad/s),r (rad/s),esc1_us,esc2_us,esc3_us,esc4_us"
        np.savetxt(folder / f"{name}_fc.csv", table, "%.5f", ",", header=head, comments="")


def _flown(path) -> np.ndarray:
    """Time, place, roll, pitch, yaw, body rates, commands in [0, 1]; 100 samples a second."""
    state = np.concatenate([path(0.0)[:3], np.zeros(3), [0, 0, 0, 1], np.zeros(3),
                            np.full(4, np.sqrt(MASS * GRAVITY / 4.0 / FULL))])  # fmt: skip
    out, drift = [], np.zeros(3)
    for k in range(round(SECONDS / STEP)):
        if k % EVERY == 0:
            turn = Rotation.from_quat(state[6:10])
            asked = np.array(path(k * STEP), dtype=float)
            drift = np.clip(drift + 0.003 * (asked[:3] - state[:3]), -1.5, 1.5)
            command = _commanded(state[:3], state[3:6], turn, state[10:13], drift, asked)
            angles = turn.as_euler("ZYX")[::-1]
            out.append(np.concatenate([[k * STEP], state[:3], angles, state[10:13], command]))
        a = _rates(state, command)
        b = _rates(state + 0.5 * STEP * a, command)
        c = _rates(state + 0.5 * STEP * b, command)
        d = _rates(state + STEP * c, command)
        state = state + STEP / 6.0 * (a + 2.0 * b + 2.0 * c + d)
        state[6:10] /= np.linalg.norm(state[6:10])
    return np.array(out)


def _rates(state, command) -> np.ndarray:
    turn, spin, speeds = Rotation.from_quat(state[6:10]), state[10:13], state[13:]
    lift, *moments = MIX @ (FULL * speeds**2)
    pull = turn.apply([0.0, 0.0, lift / MASS]) - [0.0, 0.0, GRAVITY]
    faster = (np.array(moments) - np.cross(spin, INERTIA * spin)) / INERTIA
    x, y, z, w = state[6:10]
    p, q, r = spin
    turning = 0.5 * np.array([w * p + y * r - z * q, w * q + z * p - x * r, w * r + x * q - y * p,
                              -x * p - y * q - z * r])  # fmt: skip
    return np.concatenate([state[3:6], pull, turning, faster, (command - speeds) / LAG])


def _commanded(place, velocity, turn, spin, drift, asked) -> np.ndarray:
    """Speeds of the rotors as shares of the full one: a cascade of place and attitude."""
    want = 4.0 * np.clip(asked[:3] - place, -0.8, 0.8) - 3.2 * velocity + drift
    want[2] += GRAVITY
    up = want / np.linalg.norm(want)
    left = np.cross(up, [np.cos(asked[3]), np.sin(asked[3]), 0.0])
    left /= np.linalg.norm(left)
    wanted, now = np.stack([np.cross(left, up), left, up], 1), turn.as_matrix()
    off = 0.5 * (wanted.T @ now - now.T @ wanted)[[2, 0, 1], [1, 2, 0]]
    faster = -np.array([80.0, 80.0, 14.0]) * off - np.array([14.0, 14.0, 5.0]) * spin
    thrusts = np.linalg.pinv(MIX) @ np.array([MASS * want @ now[:, 2], *(INERTIA * faster)])
    return np.sqrt(np.clip(thrusts, 0.05 * FULL, 0.98 * FULL) / FULL)
