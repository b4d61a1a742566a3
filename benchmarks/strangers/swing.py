"""A pendulum on a geared motor; the encoder sits behind a coupling with play (SciPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HIDDEN = "the encoder's coupling has a play of 1.6 deg: 9.1 counts to either side"
INERTIA, DAMPING, WEIGHT = 0.0172, 0.021, 0.94  # kg m^2, N m s, N m
TORQUE_PER_AMPERE = 0.37
COUNTS = 4096.0 / (2.0 * np.pi)  # per radian
PLAY = np.deg2rad(1.6) / 2.0
STEP, SECONDS = 0.01, 8.0
CURRENTS = {
    "slow sine": lambda t: 1.1 * np.sin(2.0 * t),
    "fast sine": lambda t: 0.45 * np.sin(5.5 * t),
    "steps": lambda t: np.where(t % 4.0 < 2.0, 1.2, -0.7),
    "sweep": lambda t: 0.6 * np.sin(2.0 * np.pi * (0.15 + 0.04 * t) * t),
    "two tones": lambda t: 0.7 * np.sin(3.1 * t) + 0.2 * np.sin(6.1 * t),
}


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each test, with semicolons, milliseconds, counts and milliamperes."""
    t = np.arange(0.0, SECONDS, STEP)
    for name, current in CURRENTS.items():
        asked = current(t)

        def rates(s: float, y: np.ndarray, asked: np.ndarray = asked) -> tuple[float, float]:
            torque = TORQUE_PER_AMPERE * asked[min(int(s / STEP + 1e-9), len(t) - 1)]
            return y[1], (torque - DAMPING * y[1] - WEIGHT * np.sin(y[0])) / INERTIA

        span, fine = (0.0, SECONDS), {"max_step": 2e-3, "rtol": 1e-8}
        angle = solve_ivp(rates, span, (0.0, 0.0), t_eval=t, **fine).y[0]
        shown, seen = rng.uniform(-PLAY, PLAY), np.empty(len(t))
        for k, true in enumerate(angle):
            shown = min(max(shown, true - PLAY), true + PLAY)
            seen[k] = shown
        counts = np.round(COUNTS * seen + rng.normal(0.0, 0.6, len(t)))
        table = np.column_stack([1000.0 * t, counts, 1000.0 * asked])
        np.savetxt(
            folder / f"{name.replace(' ', '_')}.csv",
            table,
            delimiter=";",
            header="millis;enc_cnt;i_mA",
            comments="",
            fmt=("%.0f", "%.0f", "%.1f"),
        )
