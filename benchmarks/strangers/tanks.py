"""Two tanks, one above the other; ultrasonic levels with waves and stray echoes (SciPy)."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HIDDEN = "nothing; 1.5 % of the levels are stray echoes, noise is colored (0.8 from row to row)"
AREA, UPPER_HOLE, LOWER_HOLE = 0.0154, 5.1e-5, 4.6e-5  # m^2
PUMP = 1.05e-6  # m^3/s per percent
STEP, SECONDS = 2.0, 900.0
NOISE, KEPT, STRAY = 0.12, 0.8, 0.015  # cm, from row to row, share of rows
DAYS = {
    "day1": lambda t: np.where(t % 300.0 < 150.0, 60.0, 35.0),
    "day2": lambda t: np.where(t % 300.0 < 150.0, 60.0, 35.0),
    "day3": lambda t: 30.0 + 25.0 * np.sin(2.0 * np.pi * t / 400.0) ** 2,
    "day4": lambda t: np.clip(20.0 + t / 15.0, 0.0, 70.0),
    "day5": lambda t: np.repeat([40.0, 65.0, 30.0, 55.0, 45.0], len(t) // 5),
}


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each day, with dates for a clock and a few rows without a level."""
    t = np.arange(0.0, SECONDS, STEP)
    for day, (name, driven) in enumerate(DAYS.items(), 1):
        pump = np.round(driven(t))

        def rates(s: float, h: np.ndarray, pump: np.ndarray = pump) -> tuple[float, float]:
            upper, lower = np.sqrt(2.0 * 9.81 * np.maximum(h, 0.0)) * (UPPER_HOLE, LOWER_HOLE)
            inflow = PUMP * pump[min(int(s / STEP + 1e-9), len(t) - 1)]
            return (inflow - upper) / AREA, (upper - lower) / AREA

        start = (0.03 + 0.02 * rng.random(), 0.05)
        levels = solve_ivp(rates, (0.0, SECONDS), start, t_eval=t, max_step=1.0, rtol=1e-8).y
        upper, lower = (_seen(100.0 * h, rng) for h in levels)
        begun = datetime(2026, 3, day, 9)
        lines = ["No.,Date,Pump %,Level upper (cm),Level lower (cm)"]
        for i, s in enumerate(t):
            shown = "NaN" if rng.random() < 0.01 else f"{lower[i]:.2f}"
            date = begun + timedelta(seconds=float(s))
            lines.append(f"{i + 1},{date},{pump[i]:.0f},{upper[i]:.2f},{shown}")
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _seen(level: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Levels with waves, which last some rows, and stray echoes."""
    waves = rng.normal(0.0, NOISE, len(level))
    for i in range(1, len(level)):
        waves[i] = KEPT * waves[i - 1] + np.sqrt(1.0 - KEPT**2) * waves[i]
    seen = level + waves
    stray = rng.random(len(level)) < STRAY
    seen[stray] += rng.choice([-1.0, 1.0], stray.sum()) * rng.uniform(2.0, 6.0, stray.sum())
    return seen
