"""Losses on the scale of thesis Table 4.4: 1 is a random guess, 0 a desired solution."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from diffsim.applications.application import Application
from diffsim.applications.minimise import Record

NUM_RANDOM = 16
RANDOM_SEED = 1


def random_losses(
    application: Application, *, record: Path | None = None, count: int = NUM_RANDOM
) -> list[float]:
    """Losses of random parameters, uniform between the bounds; failed simulations are left out."""
    rng, kept = np.random.default_rng(RANDOM_SEED), Record(record)
    points = [application.parameters.random(rng) for _ in range(count)]
    losses = [kept.at(application, p, gradient=False).loss for p in points]
    return [loss for loss in losses if np.isfinite(loss)]


def normalised(loss: float, random: float, desired: float) -> float:
    """(loss - desired) / (random - desired)."""
    return (loss - desired) / (random - desired)
