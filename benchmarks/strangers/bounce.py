"""A rubber ball thrown onto a floor, filmed from the side at 120 frames per second (NumPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = (
    "air drag of 0.0547 / m, and a clock that is 0.4 % slow: frames are 8.3 ms apart, not 8.333"
)
RADIUS, MASS, GRAVITY = 0.033, 0.045, 9.81
RESTITUTION, FRICTION, INERTIA_RATIO = 0.74, 0.35, 0.4
DRAG = 0.5 * 1.2 * 1.2 * np.pi * RADIUS**2  # N s^2/m^2
STEP, FRAMES, SECONDS = 1e-4, 120.0, 1.1
THROWS = {
    "t1": (0.0, 1.1, 2.2, 0.5),
    "t2": (0.0, 0.8, 3.4, 1.5),
    "t3": (0.1, 1.4, 1.5, -0.5),
    "t4": (0.0, 0.6, 4.2, 1.0),
    "t5": (0.2, 1.2, 2.9, 0.0),
    "t6": (0.0, 1.0, 3.8, 0.8),
}


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one table with a row for each frame of each throw, in millimeters."""
    rows = []
    for name, (x, z, vx, vz) in THROWS.items():
        for k, place in enumerate(_thrown(np.array([x, 0.0, z]), np.array([vx, 0.1, vz]))):
            seen = 1000.0 * place + rng.normal(0.0, 0.8, 3)
            rows.append(f"{name},{k},{k / FRAMES:.5f}," + ",".join(f"{v:.2f}" for v in seen))
    head = "throw,frame,t,X_mm,Y_mm,Z_mm"
    (folder / "ball.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")


def _thrown(place: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Center at every frame, (num_frames, 3) [m]; impacts slide or stick, as Coulomb has it."""
    spin, out = np.zeros(3), []
    every = round(1.0 / FRAMES / STEP)  # 83 steps of 0.1 ms: nobody meant the clock to be slow
    for k in range(round(SECONDS / STEP)):
        if k % every == 0:
            out.append(place.copy())
        pull = -DRAG * np.linalg.norm(velocity) * velocity / MASS - [0.0, 0.0, GRAVITY]
        velocity = velocity + STEP * pull
        place = place + STEP * velocity
        if place[2] < RADIUS and velocity[2] < 0.0:
            arm = np.array([0.0, 0.0, -RADIUS])
            slip = (velocity + np.cross(spin, arm)) * [1.0, 1.0, 0.0]
            normal = -(1.0 + RESTITUTION) * velocity[2]
            stick = np.linalg.norm(slip) / (1.0 + 1.0 / INERTIA_RATIO)
            amount = min(FRICTION * normal, stick)
            push = -amount * slip / max(np.linalg.norm(slip), 1e-12)
            velocity = velocity + push + [0.0, 0.0, normal]
            spin = spin + np.cross(arm, push) / (INERTIA_RATIO * RADIUS**2)
            place[2] = RADIUS
    return np.array(out)
