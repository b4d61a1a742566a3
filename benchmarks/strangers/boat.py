"""A boat on a lake: a total station and the thruster log by themselves (SciPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

HIDDEN = "drag of the hull that grows with the square of the speed, 4.5 N s^2/m^2"
MASS, DAMPING, SQUARE = 41.3, 5.6, 4.5
#: Times [s] and thrust [N] between straight lines.
RUNS = {
    "calm1": ([0, 3, 15, 18, 30, 33, 60], [0, 25, 25, 60, 60, 0, 0]),
    "calm2": ([0, 5, 20, 26, 40, 45, 60], [0, 70, 70, -20, -20, 0, 0]),
    "slow": ([0, 4, 25, 30, 60], [0, 12, 12, 18, 18]),
    "pulse": ([0, 5, 8, 12, 16, 20, 24, 28, 60], [0, 0, 60, 0, 50, 0, 40, 0, 0]),
    "sprint": ([0, 6, 30, 36, 60], [0, 80, 80, 10, 10]),
}


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write two files for each run; the clocks begin and step differently."""
    for name, (at, thrust) in RUNS.items():

        def rates(t, y, at=at, thrust=thrust):
            push = np.interp(t, at, thrust)
            return y[1], (push - DAMPING * y[1] - SQUARE * y[1] * abs(y[1])) / MASS

        seen = np.arange(1.0, 58.0, 0.1)
        motion = solve_ivp(rates, (0.0, 60.0), (0.0, 0.0), t_eval=seen, max_step=0.05, rtol=1e-9)
        place = motion.y[0] + rng.normal(0.0, 0.012, len(seen))
        table = np.column_stack([seen, place])
        head = "t [s];Distance [m]"
        np.savetxt(folder / f"{name}_station.csv", table, "%.4f", ";", header=head, comments="")
        logged = np.arange(0.0, 60.0, 0.04)
        table = np.column_stack([1000.0 * logged, np.interp(logged, at, thrust)])
        head = "millis,thrust_set_N"
        np.savetxt(folder / f"{name}_thruster.csv", table, "%.3f", ",", header=head, comments="")
