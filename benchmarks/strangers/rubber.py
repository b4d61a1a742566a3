"""A strip of soft rubber, bent and let go: modes of Euler and Bernoulli, Kelvin-Voigt."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.optimize import brentq

HIDDEN = "a clip of 2.0 g at the tip that holds the weights and that nobody weighed"
LENGTH, WIDE, THICK = 0.12, 0.03, 0.010  # along x, z (up) and y, in which it bends [m]
YOUNG, DENSITY, LOSS = 2.0e6, 1100.0, 2.0e-3  # [Pa], [kg/m^3], Kelvin-Voigt time [s]
CLIP = 2.0e-3  # [kg]
NOISE = 0.05e-3  # of the camera [m]


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each release; the camera films along z."""
    for name, payload, bent in (
        ("bare_1", 0.0, 9e-3),
        ("bare_2", 0.0, 9e-3),
        ("bare_small", 0.0, 4e-3),
        ("with_5g_1", 5e-3, 8e-3),
        ("with_5g_2", 5e-3, 8e-3),
        ("with_10g", 10e-3, 8e-3),
    ):
        t = np.arange(0.0, 1.6, 0.01)
        shown = 1e3 * (_moved(t, payload + CLIP, bent) + rng.normal(0.0, NOISE, (2, len(t))))
        np.savetxt(
            folder / f"{name}.csv",
            np.column_stack([t, *shown]),
            delimiter=";",
            header="time [s];mid [mm];tip [mm]",
            comments="",
            fmt="%.4f",
        )


def _moved(t: np.ndarray, mass: float, bent: float) -> np.ndarray:
    """Displacement at the middle and the tip after a release from a static deflection."""
    line = DENSITY * WIDE * THICK  # [kg/m]
    stiff = YOUNG * WIDE * THICK**3 / 12.0
    ratio = mass / (line * LENGTH)

    def frequency(b: float) -> float:
        c, s, ch, sh = np.cos(b), np.sin(b), np.cosh(b), np.sinh(b)
        return float((1.0 + c * ch) / ch + ratio * b * (c * sh - s * ch) / ch)

    out = np.zeros((2, len(t)))
    x = np.linspace(0.0, 1.0, 2001)
    static = bent * 0.5 * (3.0 * x**2 - x**3)  # pushed at the tip
    for mode in range(4):
        low = 1e-3 if mode == 0 else np.pi * (mode - 0.25) + 0.05
        b = brentq(frequency, *_bracket(frequency, low))
        k = (np.cosh(b) + np.cos(b)) / (np.sinh(b) + np.sin(b))
        shape = np.cosh(b * x) - np.cos(b * x) - k * (np.sinh(b * x) - np.sin(b * x))
        weigh = np.trapezoid(shape * static, x) + ratio * shape[-1] * static[-1]
        weigh /= np.trapezoid(shape**2, x) + ratio * shape[-1] ** 2
        omega = (b / LENGTH) ** 2 * np.sqrt(stiff / line)
        decay = 0.5 * LOSS * omega**2
        own = np.sqrt(omega**2 - decay**2 + 0j)
        motion = (np.exp(-decay * t) * (np.cos(own * t) + decay / own * np.sin(own * t))).real
        out += weigh * np.outer([shape[1000], shape[-1]], motion)
    return out


def _bracket(f: object, low: float) -> tuple[float, float]:
    grid = np.linspace(low, low + np.pi, 400)
    signs = np.sign([f(b) for b in grid])  # type: ignore[operator]
    at = int(np.flatnonzero(np.diff(signs))[0])
    return float(grid[at]), float(grid[at + 1])
