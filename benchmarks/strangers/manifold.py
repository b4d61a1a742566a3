"""Tubes from one pump to three outlets, by Hagen and Poiseuille; a joint leaks (numpy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = "joint b leaks: 6 % of the flow into it is lost at every level"
VISCOSITY = 1.0e-3  # [Pa s]
TUBES = (  # from, to, diameter [m], length [m]
    ("pump", "a", 1.6e-3, 0.20),
    ("a", "b", 1.2e-3, 0.15),
    ("a", "out1", 0.9e-3, 0.18),
    ("b", "out2", 0.9e-3, 0.12),
    ("b", "out3", 0.8e-3, 0.15),
)
NODES = ("pump", "a", "b")
LEAK = 0.06


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each day: levels of the pump, each held for four readings."""
    for day, most in (("mon", 12.0), ("tue", 12.0), ("wed", 18.0), ("thu", 6.0), ("fri", 20.0)):
        levels = np.repeat(np.linspace(0.15 * most, most, 8), 4)  # [mL/min]
        rows = []
        for k, level in enumerate(levels):
            shown = _flows(level / 6e7) + rng.normal(0.0, (8e-10, 8e-10, 8e-10, 1.5))
            flows = shown[:3] * 6e7
            rows.append([2.0 * k, level, *flows, shown[3] / 100.0])
        np.savetxt(
            folder / f"{day}.csv",
            np.array(rows),
            delimiter=",",
            header="time_s,pump (mL/min),q1 (mL/min),q2 (mL/min),q3 (mL/min),p (mbar)",
            comments="",
            fmt="%.5f",
        )


def _flows(pumped: float) -> np.ndarray:
    """Flows through the outlets, and the pressure at the pump."""
    conduct = {(f, t): np.pi * d**4 / (128.0 * VISCOSITY * n) for f, t, d, n in TUBES}
    matrix, right = np.zeros((3, 3)), np.array([pumped, 0.0, 0.0])
    for (start, end), g in conduct.items():
        for here, there in ((start, end), (end, start)):
            if here in NODES:
                i = NODES.index(here)
                matrix[i, i] += g
                if there in NODES:
                    matrix[i, NODES.index(there)] -= g
    into, out = conduct["a", "b"], conduct["b", "out2"] + conduct["b", "out3"]
    # a leak that takes a share of what flows in: g_leak p_b = LEAK (out + g_leak) p_b
    matrix[2, 2] += LEAK / (1.0 - LEAK) * out
    p = np.linalg.solve(matrix, right)
    del into
    outlets = (("a", "out1"), ("b", "out2"), ("b", "out3"))
    return np.array([conduct[o] * p[NODES.index(o[0])] for o in outlets] + [p[0]])
