"""Laws and causes of the library in one table: pairs of one of each that help together.

Where a law and a cause act together, the best law alone is bent by the cause, and the best cause by
the law. Along the recordings both are columns, which add up: all pairs are ranked without a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.discover.follow import FollowedRecord
from diffsim.diagnose.discover.screen import Candidate, Screen
from diffsim.identify.effect import PRIOR_WIDTH, Effect
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.gaussian import Gaussian

MOST_PAIRED = 40  # laws of a screen, the best first, that are weighed beside every cause
#: causes beside the best law, and beside the next, that are fitted in the simulator: a lag and a
#: delay are told apart by fits alone
NUM_CAUSES = (6, 2)


@dataclass(frozen=True, eq=False)
class CauseAlong:
    """A cause of the library along the recordings."""

    effect: Effect
    columns: Array  # whitened response to its scaled sizes, (num_valid, num_components)


@dataclass(frozen=True, eq=False)
class Pair:
    """A law and a cause beside it."""

    law: Candidate  # without a form
    cause: CauseAlong
    nats: float  # evidence of both over the better one alone


def causes_along(
    followed: FollowedRecord, library: Sequence[Effect], most_steps: float
) -> list[CauseAlong]:
    """Causes of the library along the recordings, a tangent for each size.

    Args:
        most_steps: Weighted steps after which no further cause is simulated.
    """
    tally = followed.fit.problem.model.simulations
    begun, out = tally.steps, []
    stands = set(followed.fit.problem.effects)
    for effect in (e for e in library if e.locate is None and e not in stands):
        if tally.steps - begun > most_steps:
            break
        try:
            columns = followed.simulated(effect) * PRIOR_WIDTH * effect.typical
        except DiffsimError:  # not even a small size of it can be simulated there
            continue
        if np.isfinite(columns).all() and columns.any():
            out.append(CauseAlong(effect, columns))
    return out


def best_pairs(screen: Screen, causes: Sequence[CauseAlong]) -> tuple[list[Pair], int]:
    """Pairs that explain more than every law and every cause alone; fits decide between them.

    Args:
        screen: Laws along the recordings.

    Returns:
        The pairs, the best first, and how many were weighed.
    """
    laws = list({(c.entry, c.variable.name): c for c in reversed(screen.holding)}.values())
    laws = sorted(laws, key=lambda c: c.rank)[:MOST_PAIRED]
    count = len(laws) * len(causes)
    if not count:
        return [], 0
    weigher = screen.weigher
    beside = []
    for cause in causes:
        gram, asked = weigher.reduced(cause.columns)
        beside.append(Gaussian(gram + np.eye(len(asked)), asked))
    alone = [sizes.nats for sizes in beside]
    every = np.hstack([cause.columns for cause in causes])
    # without what the model's numbers would follow
    seen = every - weigher.jacobian @ weigher.known.solve(weigher.jacobian.T @ every)
    ends = np.cumsum([cause.columns.shape[1] for cause in causes])[:-1]
    best, pairs = max(alone, default=0.0), []
    for law in laws:
        columns = screen.columns_of(law, law.basis.values) * law.typical
        own, right = weigher.reduced(columns)
        prior = np.eye(len(right))
        best = max(best, Gaussian(own + prior, right).nats)
        mixed = np.split(columns.T @ seen, ends, axis=1)
        for cause, sizes, cross, nats in zip(causes, beside, mixed, alone, strict=True):
            # block elimination of the cause's sizes
            left = Gaussian(*sizes.left_to(cross.T, own + prior, right))
            there = sizes.mean - sizes.solve(cross.T @ left.mean)
            if cause.effect.signed or (there > 0.0).all():
                pairs.append(Pair(law, cause, nats + left.nats))
    least = best + KEEP_NATS + float(np.log(count))
    better = sorted((p for p in pairs if p.nats > least), key=lambda p: -p.nats)
    best_laws = dict.fromkeys(p.law for p in better)
    chosen = [
        [p for p in better if p.law is law][:most]
        for law, most in zip(best_laws, NUM_CAUSES, strict=False)
    ]
    return [pair for of_law in chosen for pair in of_law], count
