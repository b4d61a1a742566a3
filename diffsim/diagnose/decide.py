"""From evidence to one verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from diffsim.diagnose.evidence import Hypothesis

KEEP_NATS = 4.0
ALONE_NATS = 3.0
EXPLAINED = 0.8


@dataclass(frozen=True)
class Decision:
    """What the evidence allows to say.

    Attributes:
        verdict: "none", "named", "ambiguous" or "unknown"; the gates speak before.
        best: The set behind the verdict, without an unknown cause.
        rivals: Other hypotheses within 3 nats, best first.
        unknown: The unknown cause's hypothesis if the verdict is "unknown".
        share: Of chi2_null - N that the best set explains.
        beside: The strongest hypothesis with an unknown cause, where evidence puts it 4 nats or
            more before the best set although that explains enough; its lead is ``lead`` [nats].
    """

    verdict: str
    best: frozenset[int]
    rivals: tuple[Hypothesis, ...]
    unknown: Hypothesis | None
    share: float
    beside: Hypothesis | None = None
    lead: float = 0.0


def decide(
    nats: Mapping[Hypothesis, float], chi2: Mapping[Hypothesis, float], num_free: float
) -> Decision:
    """Verdict from the evidence of all refitted hypotheses.

    Args:
        nats: Evidence; must hold the empty hypothesis.
        chi2: Of the hypotheses without unknown cause.
        num_free: Expected chi2 of a right model: samples less fitted parameters.
    """
    named_only = {h: e for h, e in nats.items() if h.unknown is None}
    best = prune(named_only, max(named_only, key=lambda h: named_only[h]))
    missing = chi2[Hypothesis()] - num_free
    explained = (chi2[Hypothesis()] - chi2[best]) / missing if missing > 0.0 else 1.0
    blind = [h for h in nats if h.unknown is not None]
    strongest = max(blind, key=lambda h: nats[h], default=None)
    if strongest is not None and _unknown_wins(nats, best, strongest, explained):
        return Decision("unknown", best.effects, (), strongest, explained)
    if not best.effects:
        return Decision("none", frozenset(), (), None, 0.0)
    rivals = [
        h
        for h, e in nats.items()
        if nats[best] - e < ALONE_NATS and not h.effects >= best.effects and h != best
    ]
    rivals = sorted((h for h in rivals if _is_kept(nats, h)), key=lambda h: -nats[h])
    verdict = "ambiguous" if rivals else "named"
    lead = -float("inf") if strongest is None else nats[strongest] - nats[best]
    beside = (strongest, lead) if lead >= KEEP_NATS else (None, 0.0)
    return Decision(verdict, best.effects, tuple(rivals), None, explained, *beside)


def prune(nats: Mapping[Hypothesis, float], best: Hypothesis) -> Hypothesis:
    """Drop members whose removal costs less than 4 nats, the cheapest first."""
    while best.effects:
        less = {i: Hypothesis(best.effects - {i}, best.unknown) for i in best.effects}
        cost = {i: nats[best] - nats[h] for i, h in less.items() if h in nats}
        if not cost or min(cost.values()) >= KEEP_NATS:
            break
        best = less[min(cost, key=lambda i: cost[i])]
    return best


def _unknown_wins(
    nats: Mapping[Hypothesis, float], best: Hypothesis, strongest: Hypothesis, explained: float
) -> bool:
    """Significant beside the best set, and the set explains too little (or there is none)."""
    if nats[strongest] - nats[best] < KEEP_NATS:
        return False
    return not best.effects or explained < EXPLAINED


def _is_kept(nats: Mapping[Hypothesis, float], h: Hypothesis) -> bool:
    """Whether a rival is more than the plain model with ballast."""
    return nats[h] - nats[Hypothesis()] >= KEEP_NATS
