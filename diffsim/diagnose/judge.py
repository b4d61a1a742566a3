"""From evidence to a judgement: unknown causes face the repeats, names face held-out runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffsim.data.study import Run
from diffsim.diagnose.crosscheck import swap_probability
from diffsim.diagnose.decide import Decision, decide
from diffsim.diagnose.evidence import Hypothesis
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.gate_result import GateResult
from diffsim.diagnose.search import Search
from diffsim.identify import Fit

Array = NDArray[np.float64]
SWAP_LIMIT = 0.02  # of noise alone: about three of 200 swapped draws may reach the statistic
# between: repeats may be too few to tell (what two causes outside the library looked like, 0.03 and
# 0.05 in six blocks); above, their scatter explains what the best set leaves
SWAP_OPEN = 0.1
NAMES = ("named", "ambiguous")


@dataclass(frozen=True, eq=False)
class Judgement:
    """What may be said.

    Attributes:
        decision: After all checks.
        gain: Of its best set on held-out runs; None without such runs, or without a name.
        gains: Of members of the sets that were considered, by effect.
        withdrawn: Effects that the evidence asked for and held-out runs refuted.
    """

    decision: Decision
    gain: Gain | None
    gains: dict[int, Gain]
    withdrawn: frozenset[int]


def judge(search: Search, held_out: Sequence[Run], gates: list[GateResult], seed: int) -> Judgement:
    """Decide; while a name of the best set makes held-out runs worse, withdraw the worst one.

    One at a time: members that share a misfit look bad together, and the rest may be good once one
    of them is gone. What is withdrawn takes all sets with it, so evidence decides anew.

    Args:
        search: Finished.
        held_out: Runs that no fit has seen.
        gates: Joined by the check against repeats.
        seed: Of the bootstraps.
    """
    gains: dict[int, Gain] = {}
    known: dict[Fit, list[Array]] = {}
    withdrawn: frozenset[int] = frozenset()
    while True:
        decision = confirmed(decision_of(search, withdrawn), search, gates, seed)
        if withdrawn and decision.verdict == "none":
            decision = replace(decision, verdict="unknown")
        if not held_out or decision.verdict not in NAMES:
            return Judgement(decision, None, gains, withdrawn)
        best = search.entries[Hypothesis(decision.best)].fit
        assert best is not None
        now = {}
        for i in decision.best:
            without = search.refit(decision.best - {i})
            if without is not None and without.fit is not None:
                now[i] = gain(held_out, without.fit, best, seed=seed, known=known)
        gains |= now
        harmful = [i for i, g in now.items() if g.status == "withdrawn"]
        if not harmful:
            null = search.entries[Hypothesis()].fit
            assert null is not None
            total = gain(held_out, null, best, seed=seed, known=known)
            return Judgement(decision, total, gains, withdrawn)
        withdrawn |= {min(harmful, key=lambda i: now[i].value)}
        for i in decision.best - withdrawn:  # what is left of the set must be among the candidates
            search.refit(decision.best - withdrawn - {i})
        if search.refit(decision.best - withdrawn) is not None:
            search.face_unknowns(decision.best - withdrawn)


def decision_of(search: Search, withdrawn: frozenset[int] = frozenset()) -> Decision:
    """What the evidence says, sets with withdrawn effects left out."""
    entries = {h: e for h, e in search.entries.items() if not h.effects & withdrawn}
    null = entries[Hypothesis()].fit
    assert null is not None
    # samples less effectively fitted parameters: tr (J'J) (J'J + 1)^-1
    fitted = null.problem.num_base - float(np.trace(null.covariance))
    return decide(
        {h: e.nats for h, e in entries.items()},
        {h: e.weighed.chi2 for h, e in entries.items() if h.unknown is None},
        null.num_samples - fitted,
    )


def confirmed(decision: Decision, search: Search, gates: list[GateResult], seed: int) -> Decision:
    """An unknown cause faces the repeats; the check joins the gates.

    Confirmed it stands, clearly refuted it is withdrawn. In between it stays as a rival of the best
    set, which explains too little to be named alone.
    """
    if decision.unknown is None or decision.unknown.unknown is None:
        return decision
    best = search.entries[Hypothesis(decision.best)].fit
    assert best is not None
    cause = search.unknowns[decision.unknown.unknown]
    moved = search.responses(decision.best, decision.unknown.unknown)
    p = swap_probability(best.problem, best.residual, moved, seed=seed)
    if p is None:
        return decision
    result = GateResult(
        "swap", p <= SWAP_LIMIT, p, SWAP_LIMIT, f"{cause.name}: repeats as noise scale"
    )
    if result not in gates:
        gates.append(result)
    if p <= SWAP_LIMIT:
        return decision
    if not decision.best:
        return replace(decision, verdict="none", unknown=None)
    if p <= SWAP_OPEN:
        return replace(decision, verdict="ambiguous", rivals=(decision.unknown,), unknown=None)
    return replace(decision, verdict="named", unknown=None)
