"""``python -m studies.hung_weight``: would rotary inertia of the silicone beam's weight show?

A cantilever of Euler and Bernoulli (with rotary inertia of its sections) carries a weight at its
tip, once as a point of some share of its mass, once as a rigid body with a radius of gyration.
Printed are the share that has the same first mode, and the second mode of both.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg, optimize

LENGTH_M, SIDE_M = 0.1, 0.03
DENSITY, MODULUS_PA = 1070.0, 264e3
ELEMENTS = 20
RADII_M = (0.009, 0.015, 0.020, 0.024)
LOADS_KG = (0.052, 0.102)


def modes_Hz(mass_kg: float, rotary_kg_m2: float = 0.0) -> np.ndarray:
    """Frequencies of the bar with a rigid body at its tip; cubic elements (Przemieniecki)."""
    length, area = LENGTH_M / ELEMENTS, SIDE_M**2
    second = SIDE_M**4 / 12.0
    h = length
    stiffness = np.array(
        [
            [12, 6 * h, -12, 6 * h],
            [6 * h, 4 * h**2, -6 * h, 2 * h**2],
            [-12, -6 * h, 12, -6 * h],
            [6 * h, 2 * h**2, -6 * h, 4 * h**2],
        ]
    )
    inertia = np.array(
        [
            [156, 22 * h, 54, -13 * h],
            [22 * h, 4 * h**2, 13 * h, -3 * h**2],
            [54, 13 * h, 156, -22 * h],
            [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
        ]
    )
    turning = np.array(
        [
            [36, 3 * h, -36, 3 * h],
            [3 * h, 4 * h**2, -3 * h, -(h**2)],
            [-36, -3 * h, 36, -3 * h],
            [3 * h, -(h**2), -3 * h, 4 * h**2],
        ]
    )
    one_k = MODULUS_PA * second / h**3 * stiffness
    one_m = DENSITY * (area * h / 420.0 * inertia + second / (30.0 * h) * turning)
    size = 2 * (ELEMENTS + 1)
    k, m = np.zeros((size, size)), np.zeros((size, size))
    for e in range(ELEMENTS):
        own = slice(2 * e, 2 * e + 4)
        k[own, own] += one_k
        m[own, own] += one_m
    m[-2, -2] += mass_kg
    m[-1, -1] += rotary_kg_m2
    squares = linalg.eigh(k[2:, 2:], m[2:, 2:], eigvals_only=True)
    return np.asarray(np.sqrt(squares[:2]) / (2.0 * np.pi))


def main() -> None:
    """Print the table."""
    print(f"without a weight: {modes_Hz(0.0)[0]:.2f} Hz")
    print(
        "| weight | radius of gyration | first mode | looks like a share of | second mode, both |"
    )
    print("|---|---|---|---|---|")
    for load in LOADS_KG:
        for radius in RADII_M:
            body = modes_Hz(load, load * radius**2)

            def off(share: float, load: float = load, first: float = body[0]) -> float:
                return float(modes_Hz(share * load)[0] - first)

            share = optimize.brentq(off, 0.5, 3.0)
            both = f"{body[1]:.1f}, {modes_Hz(share * load)[1]:.1f} Hz"
            head = f"| {1e3 * load:.0f} g | {1e3 * radius:.0f} mm | {body[0]:.2f} Hz "
            print(f"{head}| {share:.3f} | {both} |")


if __name__ == "__main__":
    main()
