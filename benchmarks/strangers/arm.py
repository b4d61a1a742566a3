"""A robot arm of two links in a vertical plane, PD controlled; the elbow's gear rubs (scipy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

HIDDEN = "dry friction of 0.10 N m in the gear of the elbow"
STEP = 0.005  # of controller and logger [s]
SECONDS = 4.0
INERTIA = (0.109, 0.0288, 0.0175)  # constant, coupled, of the forearm [kg m^2]
WEIGHT = (4.14, 0.94)  # [N m]
DAMPING = (0.25, 0.12)  # [N m s]
TORQUE = (2.4, 1.2)  # of a current [N m/A]
GAINS = ((14.0, 1.2), (8.0, 0.5))  # [A/rad], [A s/rad]
FRICTION = 0.10  # [N m]

Array = NDArray[np.float64]


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each run."""
    for name in ("slow", "slow_again", "wide", "quick", "steps", "figure"):
        np.savetxt(
            folder / f"{name}.csv",
            _run(name.removesuffix("_again"), rng),
            delimiter=",",
            header="t_s,q1_deg,q2_deg,i1_A,i2_A",
            comments="",
            fmt="%.6g",
        )


def _wanted(name: str, t: float) -> Array:
    s = np.sin
    return {
        "slow": np.array([0.5 * s(1.6 * t), 0.7 * s(2.3 * t)]),
        "wide": np.array([0.9 * s(2.0 * t), 1.1 * s(1.4 * t)]),
        "quick": np.array([0.3 * s(5.0 * t), 0.5 * s(6.5 * t)]),
        "steps": np.array([0.4 * np.sign(s(2.1 * t)), 0.6 * np.sign(s(3.1 * t + 0.5))]),
        "figure": np.array([0.6 * s(2.8 * t), 0.8 * s(5.6 * t + 0.4)]),
    }[name]


def _run(name: str, rng: np.random.Generator) -> Array:
    y = np.zeros(4)
    rows = []
    for k in range(int(SECONDS / STEP)):
        seen = y[:2] + rng.normal(0.0, 4e-4, 2)
        gains = np.array(GAINS)
        current = gains[:, 0] * (_wanted(name, k * STEP) - seen) - gains[:, 1] * y[2:]
        current = np.clip(current, -6.0, 6.0)
        rows.append([k * STEP, *np.degrees(seen), *current])
        y = solve_ivp(
            _rates, (0.0, STEP), y, args=(current,), method="RK45", rtol=1e-7, atol=1e-9
        ).y[:, -1]
    return np.array(rows)


def _rates(_: float, y: Array, current: Array) -> Array:
    q1, q2, w1, w2 = y
    whole, coupled, fore = INERTIA
    turn = coupled * np.sin(q2)
    mass = np.array([[whole + fore + 2.0 * coupled * np.cos(q2), fore + coupled * np.cos(q2)]] * 2)
    mass[1] = fore + coupled * np.cos(q2), fore
    weight = WEIGHT[1] * np.sin(q1 + q2)
    moment = np.array(TORQUE) * current - np.array(DAMPING) * y[2:]
    moment[1] -= FRICTION * np.tanh(w2 / 2e-3)
    moment += [turn * (2.0 * w1 * w2 + w2 * w2), -turn * w1 * w1]
    moment -= [WEIGHT[0] * np.sin(q1) + weight, weight]
    return np.array([w1, w2, *np.linalg.solve(mass, moment)])
