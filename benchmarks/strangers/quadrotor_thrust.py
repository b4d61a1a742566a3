"""The same quadrotor; the propeller lacks thrust, and takes as much torque as before."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.strangers import quadrotor

HIDDEN = "the propeller of rotor 3 gives 7 % less thrust for the same torque"


def make(folder: Path, rng: np.random.Generator) -> None:
    """Write the flights."""
    quadrotor.make(folder, rng, torque=np.ones(4))
