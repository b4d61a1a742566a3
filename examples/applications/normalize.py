"""Losses on the scale of thesis Table 4.4: 1 is a random guess, 0 a desired solution."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from examples.applications.application import Application
from examples.applications.minimize import Evaluation, log_of, losses_of

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

    An optimization that ``tried`` as many random starts has made them already.

    Args:
        application: Whose parameters are drawn.
        record: File of the losses (see ``optim.Log``); what it holds is not computed again.
        count: Number of the draws.
        tried: Random starts of an optimization.
    """
    if len(tried) >= count:
        return [e.loss for e in tried if np.isfinite(e.loss)]
    rng = np.random.default_rng(RANDOM_SEED)
    points = [application.parameters.random(rng) for _ in range(count)]
    made = losses_of(application, points, log_of(application, record), "random")
    return [e.loss for e in made if np.isfinite(e.loss)]


def normalized(loss: float, random: float, desired: float) -> float:
    """(loss - desired) / (random - desired)."""
    return (loss - desired) / (random - desired)
