"""A wrong data sheet is a cause as well, and a named cause may stand in for it.

Data sheets have normal priors. Seven standard deviations cost 25 nats, with which any cause is
credited that takes them up: of a tube with a narrow bore a leak behind it is named. So each set
without one of its members is weighed once more with the prior of one pulled parameter ten times as
wide, at the price of one more family.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from diffsim.diagnose.judge.data_sheet import WIDE, pull_limit, words_of
from diffsim.diagnose.judge.judge import NAMES, Decision
from diffsim.diagnose.judge.records import WRONG_SHEET
from diffsim.diagnose.search.evidence import (
    ALONE_NATS,
    Hypothesis,
    LaplaceEvidence,
    price_of_family,
    unrealized,
)
from diffsim.diagnose.search.weighed_sets import Search
from diffsim.identify import Fit


def without_wrong_sheets(decision: Decision, search: Search) -> Decision:
    """The decision with wrong data sheets beside the causes that may stand in for them.

    Where the record holds more than the library does, nothing is changed: pulls of data sheets are
    part of what is left then. A single cause gives way to a data sheet that leads by 3 nats.

    Args:
        decision: What the evidence and the checks allow.
        search: Sets that were weighed; those without one member of the best are fitted.
    """
    if decision.verdict not in NAMES or decision.beside is not None or decision.unknown is not None:
        return decision
    found = {i: sheet for i in decision.best if (sheet := _instead(search, decision.best, i))}
    if not found:
        return decision
    forms = {**decision.forms, **{i: off_sheet(sheet.name) for i, sheet in found.items()}}
    own = search.nats(Hypothesis(decision.best))
    instead = {
        decision.best - {i}: (off_sheet(sheet.name), own + sheet.nats) for i, sheet in found.items()
    }
    if len(decision.best) == 1 and all(sheet.nats >= ALONE_NATS for sheet in found.values()):
        at = {sheet.name: (sheet.x, sheet.sd) for sheet in found.values()}
        alone = replace(decision, verdict="none", best=frozenset(), rivals=(), equal=())
        return replace(alone, forms=forms, sheets=at, instead=instead)
    rest = Hypothesis(decision.best - set(forms))
    rivals = (rest, *(h for h in decision.rivals if h != rest))
    return replace(decision, verdict="ambiguous", rivals=rivals, forms=forms, instead=instead)


def off_sheet(name: str) -> str:
    """What stands in for a cause, in words."""
    return f"{WRONG_SHEET}{words_of(name)}"


@dataclass(frozen=True)
class _Sheet:
    """A data sheet that may be wrong.

    Attributes:
        name: Of the parameter.
        nats: Evidence, or its lead over the set with the cause.
        x, sd: Where the parameter lies with the wide prior [sd of the data sheet].
    """

    name: str
    nats: float
    x: float
    sd: float


def _instead(search: Search, best: frozenset[int], i: int) -> _Sheet | None:
    """The data sheet that explains best what a member does, if it can stand in its place."""
    rest = search.weighed.get(Hypothesis(best - {i}))
    if rest is None or rest.fit is None:
        return None
    tried = list(_wrong_sheets(rest.fit, search.num_families))
    if not tried:
        return None
    sheet = max(tried, key=lambda s: s.nats)
    lead = sheet.nats - search.nats(Hypothesis(best))
    return replace(sheet, nats=lead) if lead > -ALONE_NATS else None


def _wrong_sheets(fit: Fit, num_families: int) -> Iterator[_Sheet]:
    """Evidence of a set with the prior of one pulled parameter wide."""
    problem = fit.problem
    evidence = LaplaceEvidence(problem, fit.x, fit.residual, fit.jacobian, [], num_families)
    members = Hypothesis(frozenset(range(len(problem.effects))))
    lost = unrealized(fit, evidence.weigh(members))
    limit = pull_limit(problem.model.base)
    for j, p in enumerate(problem.model.base):
        if "@" not in p.name and abs(fit.x[j]) > limit:
            weighed = evidence.weigh(members, wide={j: WIDE})
            nats = weighed.nats - lost - price_of_family(num_families)
            yield _Sheet(p.name, nats, float(weighed.x[j]), float(weighed.sd[j]))
