"""Three load cells under dead weights, up and down, without a clock (closed form)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = "a loop of hysteresis, 0.0015 mV/V either way at half the load: 0.07 % of full scale"
CELLS = {"A12": (0.0399, 0.0012), "A13": (0.0402, 0.0042), "B02": (0.0405, 0.0012)}  # mV/V per kg
WEIGHTS = np.arange(0.0, 51.0, 5.0)  # kg
LOOP, NOISE = 0.0015, 0.0004  # mV/V


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write the calibration sheet of all cells."""
    lines = ["cell,cycle,direction,mass_kg,temp_C,out_mV_V"]
    for cell, (slope, zero) in CELLS.items():
        for cycle in range(1, 5):
            warm = 21.0 + rng.normal(0.0, 0.5)
            for way, weights in (("up", WEIGHTS), ("down", WEIGHTS[::-1])):
                share = weights / WEIGHTS[-1]
                bend = 4.0 * LOOP * share * (1.0 - share) * (-1.0 if way == "up" else 1.0)
                shown = slope * weights + zero + bend + rng.normal(0.0, NOISE, len(weights))
                lines += [
                    f"{cell},{cycle},{way},{m:g},{warm:.1f},{y:.5f}"
                    for m, y in zip(weights, shown, strict=True)
                ]
    (folder / "calibration.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
