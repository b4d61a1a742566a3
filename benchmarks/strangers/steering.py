"""A car's yaw rate and lateral acceleration at several speeds; its wheel is measured (SciPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HIDDEN = "rear tires of 78 kN/rad, the data sheet says 105; the wheel's angle is not held"
MASS, YAW_INERTIA = 1480.0, 2350.0  # kg, kg m^2
AHEAD, BEHIND = 1.15, 1.52  # axles from the center of mass [m]
FRONT, REAR = 82e3, 78e3  # N/rad
RATIO = 15.4
STEP, SECONDS = 0.02, 8.0
RUNS = {  # speed [km/h], angle of the wheel [deg]
    "lane_100": (100.0, lambda t: 20.0 * np.sin(0.9 * np.pi * t) * (t > 1.0) * (t < 5.44)),
    "sine_60": (60.0, lambda t: 40.0 * np.sin(np.pi * t)),
    "sine_90": (90.0, lambda t: 25.0 * np.sin(1.4 * np.pi * t)),
    "step_80": (80.0, lambda t: np.where((t > 1.0) & (t < 5.0), 30.0, 0.0)),
    "step_80b": (80.0, lambda t: np.where((t > 1.0) & (t < 5.0), 30.0, 0.0)),
    "sweep_70": (70.0, lambda t: 25.0 * np.sin(2.0 * np.pi * (0.2 + 0.12 * t) * t)),
}


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each drive, with milliseconds since 1970."""
    t = np.arange(0.0, SECONDS, STEP)
    for name, (kmh, driven) in RUNS.items():
        wheel, speed = driven(t), kmh / 3.6

        def forces(
            s: float, y: np.ndarray, wheel: np.ndarray = wheel, speed: float = speed
        ) -> tuple[float, float]:
            steer = np.radians(np.interp(s, t, wheel)) / RATIO
            front = FRONT * (steer - (y[0] + AHEAD * y[1]) / speed)
            return front, REAR * (BEHIND * y[1] - y[0]) / speed

        def rates(s: float, y: np.ndarray, speed: float = speed, at=forces) -> tuple[float, float]:
            front, rear = at(s, y)
            turn = (AHEAD * front - BEHIND * rear) / YAW_INERTIA
            return (front + rear) / MASS - speed * y[1], turn

        fine = {"max_step": 0.01, "rtol": 1e-8, "atol": 1e-9}
        y = solve_ivp(rates, (0.0, SECONDS), (0.0, 0.0), t_eval=t, **fine).y
        lateral = [sum(forces(s, now)) / MASS for s, now in zip(t, y.T, strict=True)]
        table = np.column_stack(
            [
                1.7e12 + 1000.0 * t,
                wheel,
                np.degrees(y[1]) + rng.normal(0.0, 0.15, len(t)),
                lateral + rng.normal(0.0, 0.05, len(t)),
                kmh + rng.normal(0.0, 0.05, len(t)),
            ]
        )
        np.savetxt(
            folder / f"{name}.csv",
            table,
            delimiter=",",
            header="ts_ms,SteeringWheelAngle_deg,YawRate_deg_s,AccLat_mps2,Speed_kmh",
            comments="",
            fmt=("%.0f", "%.2f", "%.3f", "%.4f", "%.2f"),
        )
