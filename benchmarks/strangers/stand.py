"""A test stand of rotors: thrust grows faster than the square, scales are tared by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = "thrust grows with speed to the power 2.12; both zeros are others in each sweep"
PROPELLERS = {"7x4 grey": (5.2e-6, 8.1e-6), "8x4.5 black": (9.1e-6, 1.6e-5)}  # [g], [N cm]
EXPONENT = 2.12
USUAL = 8000.0  # where the power changes nothing [rpm]
ZERO, NOISE = (6.0, 0.15), (1.2, 0.04)  # [g], [N cm]


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV of all sweeps, up and down."""
    lines = ["Propeller,Sweep,Speed (rpm),Thrust (g),Torque (N cm)"]
    for name, (thrust, torque) in PROPELLERS.items():
        for sweep in range(1, 6):
            zero = rng.normal(0.0, ZERO)
            speeds = np.linspace(2500.0, 11500.0, 13) + rng.normal(0.0, 60.0, 13)
            for speed in (*speeds, *speeds[::-1]):
                pull = thrust * speed**2 * (speed / USUAL) ** (EXPONENT - 2.0)
                shown = zero + rng.normal(0.0, NOISE) + (pull, torque * 1e-2 * speed**2)
                lines.append(f"{name},{sweep},{speed:.0f},{shown[0]:.1f},{shown[1]:.2f}")
    (folder / "all.csv").write_text("\n".join(lines) + "\n")
