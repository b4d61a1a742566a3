"""A soft finger on a table, pulled by a tendon that rubs: the elastica in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HIDDEN = "the tendon rubs: its tension falls by exp(-0.22 times the angle it has turned)"
LENGTH, RADIUS, OFFSET = 0.10, 0.006, 0.004  # [m]
YOUNG = 1.1e6  # [Pa]
FRICTION = 0.22
NOISE = 0.15e-3  # of the camera [m]


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write one CSV for each pull: tension rises, two markers are seen."""
    for name, most in (
        ("pull_1", 2.0),
        ("pull_2", 2.0),
        ("soft", 1.0),
        ("mid", 1.5),
        ("hard", 2.6),
    ):
        tension = np.linspace(0.05, most, 40)
        rows = []
        for k, pull in enumerate(tension):
            places = np.concatenate([_place(0.05, pull), _place(LENGTH, pull)])
            rows.append([0.5 * k, pull, *1e3 * (places + rng.normal(0.0, NOISE, 4))])
        np.savetxt(
            folder / f"{name}.csv",
            np.array(rows),
            delimiter=",",
            header="t (s),tension (N),mid_x (mm),mid_y (mm),tip_x (mm),tip_y (mm)",
            comments="",
            fmt="%.4f",
        )


def _place(until: float, pull: float) -> np.ndarray:
    """Place of a section: moment T d along the axis, T falling with the angle."""
    bent = pull * OFFSET / (YOUNG * np.pi * RADIUS**4 / 4.0)
    short = pull / (YOUNG * np.pi * RADIUS**2)  # what the tension compresses
    s = np.linspace(0.0, until, 4001)
    angle = np.log1p(FRICTION * bent * s) / FRICTION
    stretch = 1.0 - short * np.exp(-FRICTION * angle)
    return np.array(
        [np.trapezoid(stretch * np.cos(angle), s), np.trapezoid(stretch * np.sin(angle), s)]
    )
