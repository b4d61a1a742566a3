"""A weak second cause of one family may be the form of the first.

No law is exact. Dry friction that is right to a few percent leaves a misfit of that size, and
another law of friction takes it up, with any evidence that long records lend it. So a second cause
of a family is named only where it stands out of what the first one's form may be wrong by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from diffsim.diagnose.evidence import Hypothesis
from diffsim.diagnose.judge import NAMES, Decision
from diffsim.identify import Fit

Array = NDArray[np.float64]
FORM = 0.05  # share of what a cause does to the record that its form may be wrong by


def without_forms(decision: Decision, fit: Fit) -> Decision:
    """The decision with the set that leaves out what may be another cause's form as a rival.

    Args:
        decision: What the evidence and the checks allow.
        fit: Fit of its best set; its effects are those of the set, by ascending index.
    """
    if decision.verdict not in NAMES:
        return decision
    places = form_of(fit)
    if not places:
        return decision
    index = sorted(decision.best)
    forms = {index[i]: index[j] for i, j in places.items()}
    rest = Hypothesis(decision.best - set(forms))
    rivals = (rest, *(h for h in decision.rivals if h != rest))
    return replace(decision, verdict="ambiguous", rivals=rivals, forms=forms)


def form_of(fit: Fit) -> dict[int, int]:
    """Effects that may be another one's form, each with that other, by place in the problem.

    Compared are lengths of misfits in noise standard deviations: what the record would lack without
    the weak one, all else refitted, and what the strong one does, base parameters refitted.
    """
    problem, effects = fit.problem, fit.problem.effects
    slopes = fit.jacobian / problem.stretch(fit.x)
    scaled = problem.scaled(fit.x)
    own = [problem.columns_of(e) for e in effects]
    moved = [slopes[:, c] @ scaled[c] for c in own]
    base = list(range(problem.num_base))
    does = [_left(m, fit.jacobian[:, base]) for m in moved]
    found = {}
    for i, effect in enumerate(effects):
        others = [j for j, e in enumerate(effects) if j != i and e.family == effect.family]
        if not others:
            continue
        first = max(others, key=lambda j: does[j])
        rest = [c for c in range(len(fit.x)) if c not in own[i]]
        if _left(moved[i], fit.jacobian[:, rest]) < FORM * does[first]:
            found[i] = first
    return found


def _left(change: Array, slopes: Array) -> float:
    """Length of a change of the record after a refit of coordinates with these slopes and unit
    priors."""
    gram = slopes.T @ slopes + np.eye(slopes.shape[1])
    taken = slopes.T @ change
    squared = float(change @ change - taken @ np.linalg.solve(gram, taken))
    return float(np.sqrt(max(squared, 0.0)))
