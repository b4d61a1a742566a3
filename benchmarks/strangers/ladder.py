"""A ring of tubes between two reservoirs, with three gauges and two flow meters (NumPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = "tube 'down' is narrowed by dirt: 9 % less bore over its whole length"
VISCOSITY, DENSITY = 8.9e-4, 997.0
TUBES = {  # from, to, bore [m], length [m]
    "inlet": ("tank", "p", 1.5e-3, 0.10),
    "up": ("p", "q", 1.0e-3, 0.22),
    "down": ("p", "r", 1.0e-3, 0.22),
    "cross": ("q", "r", 0.8e-3, 0.08),
    "back": ("q", "s", 1.0e-3, 0.20),
    "front": ("r", "s", 1.1e-3, 0.20),
    "outlet": ("s", "drain", 1.5e-3, 0.10),
}
NARROWED = {"down": 0.91}
JOINTS = ("p", "q", "r", "s")


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each series: heads in cm of water, flows in mL/min, gauges in Pa."""
    for series, most in (("A", 30.0), ("B", 30.0), ("C", 45.0), ("D", 18.0), ("E", 55.0)):
        heads = np.repeat(np.linspace(4.0, most, 9), 3)
        rows = []
        for k, head in enumerate(heads):
            clean = _shown(DENSITY * 9.81 * 0.01 * head)
            seen = clean + rng.normal(0.0, [4.0, 4.0, 4.0, 2e-10, 2e-10])
            rows.append([5.0 * k, head, *seen[:3], *(6e7 * seen[3:])])
        np.savetxt(
            folder / f"series_{series}.csv",
            np.array(rows),
            delimiter="\t",
            header="sec\thead_cmH2O\tPG_p\tPG_q\tPG_r\tFM_up\tFM_out",
            comments="",
            fmt="%.4f",
        )


def _shown(inlet: float) -> np.ndarray:
    """Pressures at p, q and r [Pa], flows through up and outlet [m^3/s]."""
    conduct = {
        name: np.pi * (d * NARROWED.get(name, 1.0)) ** 4 / (128.0 * VISCOSITY * length)
        for name, (_, _, d, length) in TUBES.items()
    }
    matrix, right, known = np.zeros((4, 4)), np.zeros(4), {"tank": inlet, "drain": 0.0}
    for name, (start, end, _, _) in TUBES.items():
        for here, there in ((start, end), (end, start)):
            if here not in JOINTS:
                continue
            i = JOINTS.index(here)
            matrix[i, i] += conduct[name]
            if there in JOINTS:
                matrix[i, JOINTS.index(there)] -= conduct[name]
            else:
                right[i] += conduct[name] * known[there]
    p = dict(zip(JOINTS, np.linalg.solve(matrix, right), strict=True))
    flows = [conduct["up"] * (p["p"] - p["q"]), conduct["outlet"] * p["s"]]
    return np.array([p["p"], p["q"], p["r"], *flows])
