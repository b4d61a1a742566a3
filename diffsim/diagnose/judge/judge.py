"""From evidence to one verdict; unknown causes face the repeats, names face a validation.

Validation is by runs with use: select, else fit runs that are left out one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from diffsim.diagnose.checks.gates import MUCH_LEFT, GateResult, contradiction_gate
from diffsim.diagnose.judge.crosscheck import repeated_gate
from diffsim.diagnose.judge.gain import Gain, SelectRuns, Validation, gain_over
from diffsim.diagnose.judge.left_out import run_apart
from diffsim.diagnose.judge.records import LEVEL
from diffsim.diagnose.search.evidence import ALONE_NATS, Hypothesis
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.search import (
    LEFT_SHEET_SD,
    fitted_exactly,
    fitted_to_end,
    refit,
    weigh_unknowns_beside,
)
from diffsim.diagnose.search.simulations import Members
from diffsim.identify.effect import is_of_run
from diffsim.identify.effort import KEEP_NATS

EXPLAINED = 0.8  # share of the misfit that a named set explains
NAMES = ("named", "ambiguous")
MOST_TRIED = 6  # sets whose gain is asked beside an unknown cause, or in the place of members


@dataclass(frozen=True)
class Decision:
    """Verdict that the evidence allows, with the sets behind it."""

    verdict: str  # "none", "named", "ambiguous" or "unknown"; the gates speak before
    best: frozenset[int]  # the set behind the verdict, without an unknown cause
    # other hypotheses within 3 nats of evidence, or of fit (``fits_as_well``), best first
    rivals: tuple[Hypothesis, ...]
    unknown: Hypothesis | None  # the unknown cause's hypothesis if the verdict is "unknown"
    # share of the misfit, chi2_null - N, that the best set explains; or the same with what data
    # sheets say against a fit, if more
    share: float
    # the strongest hypothesis with an unknown cause, where evidence puts it 4 nats or more before
    # the best set although that explains enough; its lead is ``lead`` [nats]
    beside: Hypothesis | None = None
    lead: float = 0.0
    # effects that may be the form of another one of the set, each with what they may be
    forms: Mapping[int, str] = field(default_factory=dict)
    equal: tuple[Hypothesis, ...] = ()  # those of the rivals that fit as well
    # parameters whose data sheet is wrong in place of a cause: where a wide prior puts them and
    # their sd, in standard deviations of the data sheet
    data_sheets: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    # wrong data sheets in place of a member of the best set: what it leaves, with the data sheet in
    # words and the evidence of both [nats]
    instead: Mapping[frozenset[int], tuple[str, float]] = field(default_factory=dict)

    @property
    def open_unknown(self) -> Hypothesis | None:
        """The unknown cause behind the verdict, or that of a rival beside the best set."""
        beside = (h for h in self.rivals if h.unknown is not None and h.effects >= self.best)
        return self.unknown or next(beside, None)


def decide(
    nats: Mapping[Hypothesis, float],
    chi2: Mapping[Hypothesis, float],
    num_free: float,
    pulls: Mapping[Hypothesis, float] | None = None,
    num_sizes: Mapping[Hypothesis, int] | None = None,
    prices: Mapping[Hypothesis, float] | None = None,
    off: Mapping[Hypothesis, float] | None = None,
) -> Decision:
    """Verdict from the evidence of all refitted hypotheses.

    Args:
        nats: Evidence; must hold the empty hypothesis.
        chi2: Misfit |W (y - S)|^2 of each hypothesis without unknown cause.
        num_free: Expected chi2 of a right model: samples less fitted parameters.
        pulls: Squares of the coordinates at the optimum, by hypothesis: what data sheets and usual
            sizes say against it. Added to the misfit; None: zero.
        num_sizes: Components of all sizes of a hypothesis; None: one for each effect.
        prices: What the choice of the formulas of a hypothesis costs [nats]; None: nothing.
        off: How far the number of the model is off its data sheet that is farthest [sd]; None: not.
    """
    pulled = {h: value + (pulls or {}).get(h, 0.0) for h, value in chi2.items()}
    cost = {h: value + 2.0 * (prices or {}).get(h, 0.0) for h, value in pulled.items()}
    free = num_sizes or {h: len(h.effects) for h in cost}
    named_only = {h: e for h, e in nats.items() if h.unknown is None}
    best = prune(named_only, max(named_only, key=lambda h: named_only[h]))
    # a plain model that fits because it left its data sheets is explained where the set does not
    costs = [(cost[Hypothesis()], cost[best]) for cost in (chi2, pulled)]
    explained = max(
        (plain - left) / (plain - num_free) if plain > num_free else 1.0 for plain, left in costs
    )
    blind = [h for h in nats if h.unknown is not None]
    strongest = max(blind, key=lambda h: nats[h], default=None)
    lead = -float("inf") if strongest is None else nats[strongest] - nats[best]
    # a tank with a float valve kept "command offset", 82 % of the misfit, with an outlet 13 sd too
    # wide and 34 noise sd left
    is_bent = chi2[best] > MUCH_LEFT**2 * num_free and (off or {}).get(best, 0.0) > LEFT_SHEET_SD
    # significant beside the best set, and the set explains too little (or there is none)
    if lead >= KEEP_NATS and (not best.effects or explained < EXPLAINED or is_bent):
        return Decision("unknown", best.effects, (), strongest, explained)
    if not best.effects:
        return Decision("none", frozenset(), (), None, 0.0)
    # where the record holds more, what single samples say of two sets is not theirs alone
    equal = fits_as_well(cost, free, best) if lead < KEEP_NATS else frozenset()
    rivals = [
        h
        for h, e in nats.items()
        if (nats[best] - e < ALONE_NATS or h in equal)
        and h != best
        # of what explains too little, what acts may be an unknown cause, too
        and (not h.effects >= best.effects or (h == strongest and explained < EXPLAINED))
    ]
    # a rival has the evidence over the plain model that an effect must add
    kept = (h for h in rivals if nats[h] - nats[Hypothesis()] >= KEEP_NATS)
    rivals = sorted(kept, key=lambda h: -nats[h])
    verdict = "ambiguous" if rivals else "named"
    beside = (strongest, lead) if lead >= KEEP_NATS else (None, 0.0)
    as_well = tuple(h for h in rivals if h in equal)
    return Decision(verdict, best.effects, tuple(rivals), None, explained, *beside, equal=as_well)


def fits_as_well(
    cost: Mapping[Hypothesis, float], free: Mapping[Hypothesis, int], best: Hypothesis
) -> frozenset[Hypothesis]:
    """Other sets of no more effects than the best one that explain the records as well.

    Evidence prefers the set whose freedom was used less: one weak rotor to a center of mass that
    lies, by chance, on its arm. That tells which is likelier if one of the two acts, not which it
    is: a name that stands alone must fit better than what would stand in its place.

    Args:
        cost: Misfit with pulls of each hypothesis without unknown cause.
        free: Components of its sizes; one more than the best set has is allowed. What has many
            fits anything.
    """
    return frozenset(
        h
        for h, value in cost.items()
        if h.effects
        and len(h.effects) <= len(best.effects)
        and free[h] <= free[best] + 1
        and not h.effects >= best.effects
        and 0.5 * (value - cost[best]) < ALONE_NATS
    )


def prune(nats: Mapping[Hypothesis, float], best: Hypothesis) -> Hypothesis:
    """Drop members whose removal costs less than 4 nats, the cheapest first."""
    while best.effects:
        less = {i: Hypothesis(best.effects - {i}, best.unknown) for i in best.effects}
        cost = {i: nats[best] - nats[h] for i, h in less.items() if h in nats}
        if not cost or min(cost.values()) >= KEEP_NATS:
            break
        best = less[min(cost, key=lambda i: cost[i])]
    return best


@dataclass(frozen=True, eq=False)
class Judgment:
    """Decision after the checks by the validation and on repeats."""

    decision: Decision
    # behind it, with what was refitted for the checks; None if nothing was searched
    search: Search | None = None
    # gain of the best set on the validation; None without one, or without a name
    gain: Gain | None = None
    # gain on the validation of each member of the sets that were considered, by index of the effect
    gains: Mapping[int, Gain] = field(default_factory=dict)
    # effects that the evidence asked for and the validation refuted
    withdrawn: frozenset[int] = frozenset()
    gates: tuple[GateResult, ...] = ()  # checks of unknown causes against repeats
    refuted: frozenset[int] = frozenset()  # unknown causes, by index, that repeats refuted
    # effects that remove error from what they were not fitted to although the verdict is "unknown":
    # the extended model holds them, their names are not known
    helps: frozenset[int] = frozenset()
    # effects outside the best set that do nearly as well as members of it on what they were not
    # fitted to, each with these members
    as_good: Mapping[int, frozenset[int]] = field(default_factory=dict)


def judge(search: Search, validation: Validation | None, seed: int) -> Judgment:
    """Decide; while a name of the best set makes unseen runs worse, withdraw the one that does so
    most surely, by the end of its interval: of two that go together rounding decides the values.

    One at a time: members that share a misfit look bad together, and the rest may be good once one
    of them is gone. What is withdrawn takes all sets with it, so evidence decides anew.

    Args:
        search: Search with all sets that were weighed.
        validation: What names are held against; None: the evidence alone decides.
        seed: Seed of the bootstraps.
    """
    gains: dict[int, Gain] = {}
    gates: tuple[GateResult, ...] = ()
    withdrawn: frozenset[int] = frozenset()
    refuted: frozenset[int] = frozenset()
    while True:
        asked, search = _decided_exactly(search, withdrawn)
        decision, checks = confirmed(asked, search, seed)
        h = asked.open_unknown
        if h is not None and h.unknown is not None and decision.open_unknown is None:
            refuted |= {h.unknown}
        gates = (*gates, *(g for g in checks if g not in gates))
        if decision.verdict == "none":
            against = _contradiction(search, validation)
            gates = (*gates, *against)
            if against or _took_misfit(search, withdrawn):
                decision = replace(decision, verdict="unknown")
        elif decision.verdict == "unknown":
            steps = search.null.case.settings.plain_steps
            apart = contradiction_gate(run_apart(search.fit_of(frozenset()), steps))
            gates = (*gates, *(g for g in apart if g not in gates))
        judgment = Judgment(decision, search, None, gains, withdrawn, gates, refuted)
        if validation is None:
            return judgment
        if decision.verdict not in NAMES:
            return _with_help(judgment, validation, seed)
        parts = [decision.best - {i} for i in sorted(decision.best)]
        for part in parts:
            search = refit(search, part)
        if fitted := [p for p in parts if p and p in search.fits]:
            search = fitted_to_end(search, fitted, decision.best)
        if (better := decision_of(search, withdrawn).best) != decision.best:
            search = _ready_without(search, better)  # a part is enough, which nobody had fitted
            continue
        best = search.fit_of(decision.best)
        now: dict[int, Gain] = {}
        for i in sorted(decision.best):
            without = search.posteriors.get(Hypothesis(decision.best - {i}))
            if without is None or without.fit is None:
                continue
            if (gain := gain_over(validation, without.fit, best, seed)) is not None:
                now[i] = gain
        gains = gains | now
        harmful = {i: g.high for i, g in now.items() if g.status == "withdrawn"}
        if validation.residuals(best) is None:  # it diverges there: without the one missed least
            less = {i: Hypothesis(decision.best - {i}) for i in sorted(decision.best)}
            harmful = {i: -search.nats(h) for i, h in less.items() if h in search.posteriors}
        if not harmful:
            total = gain_over(validation, search.fit_of(frozenset()), best, seed)
            judgment = replace(judgment, search=search, gain=total, gains=gains)
            return replace(judgment, as_good=as_good(judgment, validation, seed))
        withdrawn |= {min(harmful, key=lambda i: harmful[i])}
        search = _ready_without(search, decision.best - withdrawn)


def _took_misfit(search: Search, withdrawn: Members) -> bool:
    """Whether something is missing from the record in place of what was withdrawn: evidence of data
    sheets alone, which numbers of the model were off, asks for nothing."""
    plain = search.fit_of(frozenset()).chi2
    return any(
        0.5 * (plain - weighed.chi2) >= KEEP_NATS
        for h, weighed in search.posteriors.items()
        if h.unknown is None and h.effects & withdrawn
    )


def _contradiction(search: Search, validation: Validation | None) -> tuple[GateResult, ...]:
    """A run with use: select that contradicts fit runs of which the plain model leaves noise."""
    if not isinstance(validation, SelectRuns):
        return ()
    found = validation.residuals(search.fit_of(frozenset()))
    if found is None:
        return ()
    pairs = zip(validation.runs, found, strict=True)
    return contradiction_gate({r.name: float(np.sqrt(np.mean(e**2))) for r, e in pairs if len(e)})


def as_good(judgment: Judgment, validation: Validation, seed: int) -> dict[int, frozenset[int]]:
    """Effects that do in the place of members nearly what these do: a large share of their misfit,
    and on what was not fitted a gain within the interval of theirs.

    Evidence tells which of two laws is the better one, not that the worse one is not what acts:
    both may be a little wrong. So no cause is refuted by such a neighbor.

    Args:
        judgment: Verdict with the gains of the members.
        validation: What these were computed on.
        seed: Seed of the bootstraps.
    """
    search, best = judgment.search, judgment.decision.best
    assert search is not None  # gains come of a search
    fits, found = search.fits, dict[int, frozenset[int]]()
    for gone, i in _swaps(search, best, judgment.withdrawn)[:MOST_TRIED]:
        rest, own = best - gone, judgment.gain
        if rest:
            own = judgment.gains.get(min(gone))
        if own is None or not own.is_above_zero:
            continue
        instead = gain_over(validation, fits[rest], fits[rest | {i}], seed)
        if instead is not None and instead.is_above_zero and instead.value >= own.low:
            found[i] = found.get(i, frozenset()) | gone
    return found


def _swaps(search: Search, best: Members, withdrawn: Members) -> list[tuple[Members, int]]:
    """A member, or all of them, and an effect that explains most of what those do; by evidence.

    None with a size for each run: it is fitted to unseen runs as well, which proves nothing. Nor
    one whose formula costs more, such as a curve that was bent by all runs.
    """
    fits, out = search.fits, list[tuple[Members, int]]()
    for members in sorted(fits, key=lambda s: -search.nats(Hypothesis(s))):
        gone, came = best - members, members - best
        rest = best - gone
        if len(came) != 1 or members & withdrawn or rest not in fits:
            continue
        if not gone or (rest and len(gone) > 1):
            continue
        effects = search.wide.effects
        if any(map(is_of_run, effects[min(came)].components)):
            continue
        if effects[min(came)].price > sum(effects[i].price for i in gone) + ALONE_NATS:
            continue
        all_of_it, share = fits[rest].chi2 - fits[best].chi2, fits[rest].chi2 - fits[members].chi2
        if share >= EXPLAINED * all_of_it:
            out.append((gone, min(came)))
    return out


def _decided_exactly(search: Search, withdrawn: Members) -> tuple[Decision, Search]:
    """The decision from a best set whose slopes are exact: it may have been far behind one whose
    effects were withdrawn."""
    tried = set[Members]()
    while (asked := decision_of(search, withdrawn)).best not in tried:
        tried.add(asked.best)
        search = fitted_exactly(search, asked.best)
    return asked, search


def _with_help(judgment: Judgment, validation: Validation, seed: int) -> Judgment:
    """With the set of effects that removes most error where an unknown cause has the verdict."""
    search, withdrawn = judgment.search, judgment.withdrawn
    if judgment.decision.verdict != "unknown" or search is None:
        return judgment
    fits = {
        h.effects: w.fit
        for h, w in search.posteriors.items()
        if h.unknown is None and h.effects and not h.effects & withdrawn and w.fit is not None
    }
    plain = search.fit_of(frozenset())
    nearest = sorted(fits, key=lambda members: -search.nats(Hypothesis(members)))[:MOST_TRIED]
    asked = {members: gain_over(validation, plain, fits[members], seed) for members in nearest}
    gains = {members: gain for members, gain in asked.items() if gain is not None}
    helpful = [members for members, gain in gains.items() if gain.is_above_zero]
    if not helpful:
        return judgment
    best = max(helpful, key=lambda m: (gains[m].low, -len(m)))
    single = {i: gains[frozenset({i})] for i in best if frozenset({i}) in gains}
    gains_of_all = {**judgment.gains, **single}
    return replace(judgment, helps=best, gain=gains[best], gains=gains_of_all)


def _ready_without(search: Search, rest: Members) -> Search:
    """What is left of a set, and its subsets, among the candidates, with unknown causes beside."""
    for i in rest:
        search = refit(search, rest - {i})
    search = refit(search, rest)
    if Hypothesis(rest) in search.posteriors:
        search = weigh_unknowns_beside(search, rest)
    return search


def decision_of(search: Search, withdrawn: frozenset[int] = frozenset()) -> Decision:
    """Decision from the evidence, sets with withdrawn effects left out."""
    posteriors = {h: w for h, w in search.posteriors.items() if not h.effects & withdrawn}
    null = search.fit_of(frozenset())
    # samples less effectively fitted parameters: tr (J'J) (J'J + 1)^-1
    fitted = null.problem.num_base - float(np.trace(null.covariance))
    sheets = [i for i, n in enumerate(null.problem.names[: null.problem.num_base]) if "@" not in n]
    return decide(
        {h: w.nats for h, w in posteriors.items()},
        {h: w.chi2 for h, w in posteriors.items() if h.unknown is None},
        null.num_samples - fitted,
        {
            h: float(w.x @ w.x) if w.fit is None else w.fit.prior
            for h, w in posteriors.items()
            if h.unknown is None
        },
        {h: sum(len(search.wide.effects[i].components) for i in h.effects) for h in posteriors},
        {h: sum(search.wide.effects[i].price for i in h.effects) for h in posteriors},
        {h: float(np.abs(w.x[sheets]).max(initial=0.0)) for h, w in posteriors.items()},
    )


def confirmed(
    decision: Decision, search: Search, seed: int
) -> tuple[Decision, tuple[GateResult, ...]]:
    """An unknown cause against the repeats: the decision after it, and the check.

    Confirmed it stands, clearly refuted it is withdrawn. In between it stays as a rival of the best
    set, which explains too little to be named alone.
    """
    asked = decision.open_unknown
    if asked is None or asked.unknown is None:
        return decision, ()
    gates = repeated_gate(search.fit_of(decision.best), seed)
    if all(gate.passed for gate in gates):
        return decision, gates
    if not decision.best:
        return replace(decision, verdict="none", unknown=None), gates
    rest = tuple(h for h in decision.rivals if h != asked)
    # noise alone is no answer that a 90 % interval would hold, though the check lets it pass
    if gates[0].value <= 1.0 - LEVEL:
        rest = decision.rivals or (asked,)
    verdict = "ambiguous" if rest else "named"
    return replace(decision, verdict=verdict, rivals=rest, unknown=None), gates
