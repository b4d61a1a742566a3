"""Commands that excite well, and what a recorder writes besides: temperature, voltage, wind."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from labs.unlisted.machine import Machine

Array = NDArray[np.float64]
Rng = np.random.Generator


def _tones(rng: Rng, time: Array, pace: float) -> Array:
    """Four tones about the pace."""
    waves = 2.0 * np.pi * pace * np.array([0.2, 0.55, 1.0, 1.9]) * rng.uniform(0.85, 1.2, 4)
    phases = rng.uniform(0.0, 2.0 * np.pi, 4)
    course = np.sin(np.outer(time, waves) + phases) @ np.array([0.45, 0.3, 0.25, 0.15])
    return np.asarray(course / np.abs(course).max())


def _steps(rng: Rng, time: Array, pace: float) -> Array:
    """Levels that are each held for half a period or more."""
    lengths = (0.5 + 1.5 * rng.random(1000)) / pace
    levels = rng.uniform(-1.0, 1.0, 1000)
    return np.asarray(levels[np.searchsorted(np.cumsum(lengths), time)])


def _sweep(rng: Rng, time: Array, pace: float) -> Array:
    """From a fifth of the pace to twice the pace."""
    low, high = 0.2 * pace, rng.uniform(1.6, 2.2) * pace
    turns = low * time + 0.5 * (high - low) * time**2 / time[-1]
    return np.asarray(0.9 * np.sin(2.0 * np.pi * turns))


def _wander(rng: Rng, time: Array, pace: float) -> Array:
    """Straight lines between levels drawn at every third of a period."""
    knots = np.arange(0.0, time[-1] + 1.0 / pace, 1.0 / (3.0 * pace))
    return np.interp(time, knots, rng.uniform(-1.0, 1.0, len(knots)))


#: Use and course of the runs of a study; further test runs follow.
PLAN: tuple[tuple[str, Callable[[Rng, Array, float], Array]], ...] = (
    ("fit", _tones),
    ("fit", _steps),
    ("fit", _sweep),
    ("fit", _wander),
    ("fit", _tones),
    ("select", _steps),
    ("select", _wander),
    ("test", _tones),
    ("test", _wander),
)

#: Columns: level, spread of the runs about it, wandering within a run, noise of what is recorded.
COLUMNS: Mapping[str, tuple[float, float, float, float]] = {
    "temp": (30.0, 12.0, 8.0, 0.1),
    "battery": (12.0, 0.9, 0.7, 0.02),
    "wind": (4.0, 1.5, 2.0, 0.05),
    "ambient": (1013.0, 12.0, 8.0, 0.1),
    "humidity": (45.0, 8.0, 6.0, 0.3),
}
LEAST = {"wind": 0.2}


def drawn_uses(rng: Rng) -> list[str]:
    """Uses of the runs: five to fit, two to choose, one or two for the test."""
    return [use for use, _ in PLAN][: int(rng.choice([len(PLAN) - 1, len(PLAN)]))]


def drawn_commands(rng: Rng, machine: Machine, num_runs: int, repeats: bool) -> dict[str, Array]:
    """Commands of all runs by name, (num_runs, num_samples).

    Args:
        rng: Source of what is drawn.
        machine: That is driven.
        num_runs: Number of runs.
        repeats: Whether the last run to fit executes the commands of the first again.
    """
    time = machine.step_s * np.arange(float(machine.count))
    rise = np.minimum(time * machine.pace / 0.3, 1.0)  # begins at rest
    commands = {
        name: np.array(
            [
                drive.middle + drive.reach * rise * course(rng, time, machine.pace)
                for _, course in PLAN[:num_runs]
            ]
        )
        for name, drive in machine.drives.items()
    }
    if repeats:
        for course in commands.values():
            course[4] = course[0]
    return commands


def drawn_column(rng: Rng, name: str, machine: Machine, num_runs: int) -> Array:
    """Slow courses, each run about a level of its own; a battery only falls.

    Args:
        rng: Source of what is drawn.
        name: Of ``COLUMNS``.
        machine: That is recorded.
        num_runs: Number of runs.
    """
    time = machine.step_s * np.arange(float(machine.count))
    level, spread, wander, _ = COLUMNS[name]
    levels = level + spread * rng.permutation(np.linspace(-1.0, 1.0, num_runs))
    knots = np.linspace(0.0, time[-1], 12 if name == "wind" else 5)
    rows = []
    for middle in levels:
        if name == "battery":
            rows.append(middle - wander * rng.uniform(0.3, 1.0) * time / time[-1])
        else:
            rows.append(middle + np.interp(time, knots, wander * rng.uniform(-1, 1, len(knots))))
    return np.maximum(np.array(rows), LEAST.get(name, -np.inf))
