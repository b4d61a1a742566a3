"""How numbers of a rig are drawn: those of its sheet, and those that it omits."""

from __future__ import annotations

import numpy as np


def off(rng: np.random.Generator, value: float, percent: float) -> float:
    """A number of the sheet as the rig has it, within 1.5 standard deviations."""
    return value * float(np.exp(percent / 100.0 * np.clip(rng.standard_normal(), -1.5, 1.5)))


def about(rng: np.random.Generator, value: float) -> float:
    """A hidden size within a quarter of the usual one."""
    return value * float(rng.uniform(0.75, 1.25))
