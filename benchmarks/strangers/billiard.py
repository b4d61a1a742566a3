"""A billiard ball pushed over a table and filmed from above at 50 frames per second (NumPy)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = "a table that is not level: 6 mrad down along x, 3 mrad up along y"
TILT = np.array([0.006, -0.003])
RADIUS, FRICTION, GRAVITY = 0.02625, 0.19, 9.81
STEP, FRAMES, SECONDS, SHOTS, LOST = 1e-4, 50, 1.3, 8, 5


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one table of all shots; frames in which the tracker lost the ball read -1."""
    rows = ["Stoss\tBild\tx [mm]\ty [mm]\tqual"]
    for i in range(SHOTS):
        heading = 2.0 * np.pi * i / SHOTS + 0.2 * rng.normal()
        velocity = rng.uniform(0.7, 1.4) * np.array([np.cos(heading), np.sin(heading)])
        seen = 1000.0 * _rolled(rng.uniform(-0.1, 0.1, 2), velocity, 15.0 * rng.normal(size=2))
        seen += rng.normal(0.0, 0.4, seen.shape)
        gone = rng.integers(10, 50)
        for k, (x, y) in enumerate(seen):
            is_lost = gone <= k < gone + LOST
            cells = "-1\t-1\t0" if is_lost else f"{x:.2f}\t{y:.2f}\t{rng.uniform(0.8, 1):.2f}"
            rows.append(f"S{i + 1}\t{1000 + k}\t{cells}")
    (folder / "billard.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")


def _rolled(place: np.ndarray, velocity: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Center at every frame, (num_frames, 2) [m]: it slides by Coulomb's law until it rolls.

    ``spin`` are the body rates about x and y [rad/s]; the lowest point moves with
    velocity + radius (-spin_y, spin_x).
    """
    down, every, out = GRAVITY * TILT, round(1.0 / FRAMES / STEP), []
    for k in range(round(SECONDS / STEP)):
        if k % every == 0:
            out.append(place.copy())
        slip = velocity + RADIUS * np.array([-spin[1], spin[0]])
        # 2/7: what the ball's inertia, 2/5 m r^2, leaves of a slip that ends within the step
        stop = -2.0 / 7.0 * (slip / STEP + down)
        most = FRICTION * GRAVITY
        rub = stop * min(1.0, most / max(np.linalg.norm(stop), 1e-12))
        spin = spin + STEP * 2.5 / RADIUS * np.array([rub[1], -rub[0]])
        before, velocity = velocity, velocity + STEP * (down + rub)
        place = place + 0.5 * STEP * (before + velocity)
    return np.array(out)
