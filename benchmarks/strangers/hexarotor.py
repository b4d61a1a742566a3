"""A controlled hexarotor: motion capture and flight controller log by themselves (SciPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

HIDDEN = "motion capture, its attitude too, is 30 ms late; the gyro is not"
LATE = 0.030
GRAVITY, MASS, ARM, FULL, TORQUE_RATIO, LAG = 9.81, 2.1, 0.275, 7.2, 0.016, 0.045
INERTIA = np.array([0.021, 0.023, 0.040])
ANGLES = np.deg2rad([30.0, 90.0, 150.0, 210.0, 270.0, 330.0])
SPIN = np.tile([1.0, -1.0], 3)  # +1: counterclockwise from above
PLACES = ARM * np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1)
MIX = np.stack([np.ones(6), PLACES[:, 1], -PLACES[:, 0], -TORQUE_RATIO * SPIN])
STEP, SECONDS = 0.002, 9.0
HEAD = "Pos X (mm);Pos Y (mm);Pos Z (mm);Roll (deg);Nick (deg);Gier (deg)"
PATHS = {
    "Kreis": lambda t: (1.2 * np.cos(1.3 * t) - 1.2, 1.2 * np.sin(1.3 * t), 1.2, 0.0),
    "Acht": lambda t: (
        1.6 * np.sin(1.1 * t), 0.8 * np.sin(2.2 * t), 1.2 + 0.2 * np.sin(1.1 * t),
        0.4 * np.sin(0.8 * t),
    ),
    "Hub": lambda t: (0.0, 0.0, 1.8 if t % 3.0 < 1.5 else 0.9, 0.5 * np.sin(1.5 * t)),
    "Sprung": lambda t: (1.2 * (t % 4.0 < 2.0), 0.8 * (t % 5.0 < 2.5), 1.2, 0.6 * (t % 6.0 < 3.0)),
    "Schnell": lambda t: (
        1.5 * np.sin(1.9 * t), 0.3 * np.sin(1.33 * t), 1.2 + 0.3 * np.sin(0.95 * t), 0.0,
    ),
}  # fmt: skip


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write two files for each flight: other columns, other names of one clock, other marks."""
    for i, (name, path) in enumerate(PATHS.items()):
        flown = _flown(path)
        time, stamp = flown[:, 0], 1_732_275_000_000 + 100_000 * i + np.round(1000.0 * flown[:, 0])
        seen = np.stack([np.interp(time - LATE, time, flown[:, k]) for k in range(1, 7)], 1)
        seen[:, :3] = 1000.0 * seen[:, :3] + rng.normal(0.0, 0.6, (len(time), 3))
        seen[:, 3:] = np.rad2deg(seen[:, 3:]) + rng.normal(0.0, 0.15, (len(time), 3))
        lost = np.any([np.abs(time - s) < 0.075 for s in rng.uniform(1.0, 8.0, 3)], axis=0)
        rows = [
            "Zeitstempel (ms);Pos X (mm);Pos Y (mm);Pos Z (mm);Roll (deg);Nick (deg);Gier (deg)"
        ]
        for k in np.flatnonzero(time > 0.5):
            cells = ["---"] * 6 if lost[k] else [f"{v:.2f}".replace(".", ",") for v in seen[k]]
            rows.append(";".join([f"{stamp[k]:.0f}", *cells]))
        (folder / f"{name}_mocap.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        gyro = np.rad2deg(flown[:, 7:10]) + rng.normal(0.0, 0.4, (len(time), 3))
        table = np.column_stack([stamp, gyro, 100.0 * flown[:, 10:]])
        head = "stamp_ms,gyro_x_dps,gyro_y_dps,gyro_z_dps," + ",".join(
            f"pwm{j}_pct" for j in range(1, 7)
        )
        form = ["%.0f"] + ["%.2f"] * 9
        np.savetxt(folder / f"{name}_fcu.csv", table, form, ",", header=head, comments="")


def _flown(path) -> np.ndarray:
    """Time, place, roll, pitch, yaw, body rates, commands in [0, 1]; 100 samples a second."""
    hover = np.sqrt(MASS * GRAVITY / 6.0 / FULL)
    place, velocity, spin = np.array([0.0, 0.0, 1.2]), np.zeros(3), np.zeros(3)
    turn, speeds, drift, out = Rotation.identity(), np.full(6, hover), np.zeros(3), []
    for k in range(round(SECONDS / STEP)):
        if k % 5 == 0:
            asked = path(k * STEP)
            drift = np.clip(drift + 0.003 * (asked[:3] - place), -1.5, 1.5)
            command = _commanded(place, velocity, turn, spin, drift, asked)
            angles = turn.as_euler("ZYX")[::-1]
            out.append(np.concatenate([[k * STEP], place, angles, spin, command]))
        half = speeds + (command - speeds) * (1.0 - np.exp(-0.5 * STEP / LAG))
        first, faster = _accelerations(turn, spin, speeds)
        middle = turn * Rotation.from_rotvec(0.5 * STEP * spin)
        on_the_way = spin + 0.5 * STEP * faster
        pull, faster = _accelerations(middle, on_the_way, half)
        place = place + STEP * (velocity + 0.5 * STEP * first)
        velocity, turn = velocity + STEP * pull, turn * Rotation.from_rotvec(STEP * on_the_way)
        spin = spin + STEP * faster
        speeds = speeds + (command - speeds) * (1.0 - np.exp(-STEP / LAG))
    return np.array(out)


def _accelerations(turn: Rotation, spin: np.ndarray, speeds: np.ndarray):
    """Of the place in the room, and of the body rates in the body."""
    lift, *moments = MIX @ (FULL * speeds**2)
    pull = turn.apply([0.0, 0.0, lift / MASS]) - [0.0, 0.0, GRAVITY]
    return pull, (np.array(moments) - np.cross(spin, INERTIA * spin)) / INERTIA


def _commanded(place, velocity, turn, spin, drift, asked) -> np.ndarray:
    """Speeds of the rotors as shares of the full one: a cascade of place and attitude."""
    want = 4.0 * np.clip(asked[:3] - place, -1.0, 1.0) - 3.2 * velocity + drift
    want[:2] = np.clip(want[:2], -4.0, 4.0)
    want[2] += GRAVITY
    up = want / np.linalg.norm(want)
    left = np.cross(up, [np.cos(asked[3]), np.sin(asked[3]), 0.0])
    left /= np.linalg.norm(left)
    wanted, now = np.stack([np.cross(left, up), left, up], 1), turn.as_matrix()
    off = 0.5 * (wanted.T @ now - now.T @ wanted)[[2, 0, 1], [1, 2, 0]]
    faster = -np.array([70.0, 70.0, 12.0]) * off - np.array([12.0, 12.0, 5.0]) * spin
    thrusts = np.linalg.pinv(MIX) @ np.array([MASS * want @ now[:, 2], *(INERTIA * faster)])
    return np.sqrt(np.clip(thrusts, 0.05 * FULL, 0.98 * FULL) / FULL)
