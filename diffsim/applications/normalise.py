"""Losses on the scale of thesis Table 4.4: 1 is a random guess, 0 a desired solution."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from diffsim.applications.application import Application
from diffsim.applications.minimise import Evaluation, Record

NUM_RANDOM = 16
RANDOM_SEED = 1


def random_losses(
    application: Application,
    *,
    record: Path | None = None,
    count: int = NUM_RANDOM,
    tried: Sequence[Evaluation] = (),
) -> list[float]:
    """Losses of random parameters, uniform between the bounds; failed simulations are left out.

    An optimisation that ``tried`` as many random starts has made them already.
    """
    if len(tried) >= count:
        return [e.loss for e in tried if np.isfinite(e.loss)]
    rng, kept = np.random.default_rng(RANDOM_SEED), Record(record)
    points = [application.parameters.random(rng) for _ in range(count)]
    losses = [kept.at(application, p, gradient=False).loss for p in points]
    return [loss for loss in losses if np.isfinite(loss)]


def normalised(loss: float, random: float, desired: float) -> float:
    """(loss - desired) / (random - desired)."""
    return (loss - desired) / (random - desired)
