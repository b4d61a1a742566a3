"""A heated plate of aluminum with two thermocouples, one of them slow (scipy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HIDDEN = "the thermocouple at the far end follows with a lag of 9 s"
HEATED, FAR = 95.0, 70.0  # heat capacities [J/K]
LINK, LOSS = 1.6, (0.35, 0.28)  # between them and to the room [W/K]
ROOM = 22.0  # [degC]
SLOW = 9.0  # [s]
POWERS = {
    "step": lambda t: np.where(t < 900.0, 40.0, 0.0),
    "step_again": lambda t: np.where(t < 900.0, 40.0, 0.0),
    "pulses": lambda t: np.where(t % 240.0 < 100.0, 55.0, 0.0),
    "stairs": lambda t: 12.0 * np.floor(t / 300.0),
    "mixed": lambda t: 25.0 + 20.0 * np.sign(np.sin(t / 60.0) + 0.3 * np.sin(t / 17.0)),
}


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each run, a row every two seconds."""
    t = np.arange(0.0, 1500.0, 2.0)
    for name, power in POWERS.items():
        start = ROOM + rng.normal(0.0, 0.3)

        def rates(s: float, y: np.ndarray, power: object = power) -> list[float]:
            heat = LINK * (y[0] - y[1])
            on = float(power(np.array(2.0 * np.floor(s / 2.0 + 1e-9))))  # type: ignore[operator]
            return [
                (on - heat - LOSS[0] * (y[0] - ROOM)) / HEATED,
                (heat - LOSS[1] * (y[1] - ROOM)) / FAR,
                (y[1] - y[2]) / SLOW,
            ]

        y = solve_ivp(rates, (0.0, t[-1]), [start] * 3, t_eval=t, max_step=1.0, rtol=1e-8).y
        shown = y[[0, 2]] + rng.normal(0.0, 0.08, (2, len(t)))
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([t, *shown, power(t)]),
            delimiter=",",
            header="t,T_heater (degC),T_end (degC),P (W)",
            comments="",
            fmt="%.3f",
        )
