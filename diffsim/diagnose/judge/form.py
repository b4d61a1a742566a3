"""A weak cause beside a strong one may be what the strong one's form has wrong.

No law is exact. Dry friction that is right to a few percent leaves a misfit of that size, and
whatever else acts there takes it up, with any evidence that long records lend it. So a weak cause
is certain only where it stands out of what a strong one's form may be wrong by: within a family,
whose members are laws of one thing, as a whole; in another family where it moves no sample by more
than the noise. Where numerical settings could not be refined as far as the answer asks, it must
stand out of what they change, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.diagnose.checks.gates import (
    NUMERICS_LAMBDA,
    could_be,
    left_over,
    length,
    moved_by,
    others_of,
)
from diffsim.diagnose.judge.judge import NAMES, Decision
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.identify import Fit
from diffsim.identify.linearization import whitened

Array = NDArray[np.float64]
FORM = 0.05  # share of what a cause does to the record that its form may be wrong by


def without_forms(
    decision: Decision, fit: Fit, unrefined: Mapping[str, Array] | None = None
) -> Decision:
    """The decision with the set that leaves out what may be another cause's form as a rival.

    Args:
        decision: What the evidence and the checks allow.
        fit: Fit of its best set; its effects are those of the set, by ascending index.
        unrefined: Change of the record by refining numerical settings for which the gate failed at
            that fit, (N,) each by its name.
    """
    if decision.verdict not in NAMES:
        return decision
    changes = {name: whitened(fit.problem, raw) for name, raw in (unrefined or {}).items()}
    places = form_of(fit, changes)
    if not places:
        return decision
    index = sorted(decision.best)
    forms = {index[i]: what for i, what in places.items()}
    rest = Hypothesis(decision.best - set(forms))
    rivals = (rest, *(h for h in decision.rivals if h != rest))
    return replace(decision, verdict="ambiguous", rivals=rivals, forms=forms)


def form_of(fit: Fit, changes: Mapping[str, Array]) -> dict[int, str]:
    """Effects that may be something else, each with what that is, by place in the problem.

    Compared are misfits in noise standard deviations: what the record would lack without the weak
    one, all else refitted, and what the strong one does, base parameters refitted. Within a family
    by their lengths; else by their mean squares where the weak one acts.

    Args:
        fit: Fit of a set of effects.
        changes: Whitened changes by refining numerical settings that the answer leaves too coarse.
    """
    effects = fit.problem.effects
    base = fit.jacobian[:, : fit.problem.num_base]
    does = [left_over(moved_by(fit, i), base) for i in range(len(effects))]
    found = {}
    for i, effect in enumerate(effects):
        lacks = left_over(moved_by(fit, i), fit.jacobian[:, others_of(fit, i)])
        others = {j: does[j] for j in range(len(effects)) if j != i}
        family = [j for j in others if effects[j].family == effect.family]
        law = max(family, key=lambda j: length(does[j]), default=i)
        coarse = [name for name, c in changes.items() if could_be(fit, i, c) >= NUMERICS_LAMBDA]
        if family and length(lacks) < FORM * length(does[law]):
            found[i] = f"another form of {effects[law].name}"
        elif (first := _strongest(lacks, others, len(fit.jacobian))) is not None:
            found[i] = f"another form of {effects[first].name}"
        elif coarse:
            found[i] = f"too coarse a {coarse[0].replace('_', ' ')}"
    return found


def _strongest(lacks: Array, does: Mapping[int, Array], num_samples: int) -> int | None:
    """The cause that does most where a weak one acts, if the latter stays below the noise and
    below what the form of the former may be wrong by."""
    power = lacks[:num_samples] ** 2
    if not does or not power.any():
        return None
    there = {j: float(power @ d[:num_samples] ** 2 / power.sum()) for j, d in does.items()}
    first = max(there, key=lambda j: there[j])
    usual = float(power @ power / power.sum())
    return first if usual < min(1.0, FORM**2 * there[first]) else None
