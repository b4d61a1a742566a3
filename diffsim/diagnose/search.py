"""Search over sets of effects, with or without an unknown cause, by Laplace evidence.

From the best set so far its neighbors (one more, one less, one swapped, a pair that masks each
other more) are ranked by linear evidence, those that could win are refitted, and the best refit
becomes the next center, until none is better. Sizes of effects with kinks are scanned before. A set
that is not refitted keeps its linear evidence, and cannot win; none that is refitted is worse than
its subsets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import process_time

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.evidence import (
    ALONE_NATS,
    KEEP_NATS,
    Hypothesis,
    LaplaceEvidence,
    Weighed,
    families,
    unrealized,
)
from diffsim.diagnose.fit import Null
from diffsim.diagnose.from_sheet import (
    LEAST_REFITS,
    center_at_sheet,
    cooled,
    has_left,
    promising_sets,
)
from diffsim.diagnose.refine import SetNumerics, numerics_of
from diffsim.diagnose.scan import BORROWED, SCAN_NATS, masking_pairs
from diffsim.diagnose.simulations import NONE, Center, Members, Simulations
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import SearchSettings
from diffsim.identify.linearization import (
    Linearization,
    linearization_at,
    measured_of,
    record_at,
    whitened,
)
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
Begin = Callable[[Problem, Linearization], Linearization]
WORSE_NATS = 0.1  # a set may end above its subsets by: fits are exact to some hundredths
FROM_SHEET = 0.5  # of the time of refits, for those from the data sheet
LONG_STEP = 0.3  # prior sd: a last step is simulated
STEP_ATOL = 0.05  # prior sd: a smaller step needs no new linearization


@dataclass(frozen=True, eq=False)
class Search:
    """Sets that were weighed so far; every step returns a copy with what it adds.

    Attributes:
        null: The plain model under its noise floor.
        simulations: Fits and slopes behind the evidence.
        plain: The plain model as a center.
        weighed: Refitted sets, and sets with an unknown cause, at their own linearization where
            the verdict hangs on it.
        linear: Sets that have linear evidence only.
        failed: Why a set could not be simulated.
        borrowed: Why slopes of an earlier center serve at a set.
        num_late: Rivals that keep their linear evidence, as ``refit_seconds`` were over.
        numerics: Numerical settings at sets where they were checked.
    """

    null: Null
    simulations: Simulations
    plain: Center
    weighed: Mapping[Hypothesis, Weighed] = field(default_factory=dict)
    linear: Mapping[Hypothesis, Weighed] = field(default_factory=dict)
    failed: Mapping[Hypothesis, str] = field(default_factory=dict)
    borrowed: Mapping[Members, str] = field(default_factory=dict)
    num_late: int = 0
    numerics: Mapping[Members, SetNumerics] = field(default_factory=dict)

    @property
    def wide(self) -> Problem:
        """Problem with all candidate effects."""
        return self.simulations.wide

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        """Generic causes of the case."""
        return self.null.case.unknowns

    @property
    def settings(self) -> SearchSettings:
        """Effort of the search."""
        return self.null.case.settings.search

    @property
    def num_families(self) -> int:
        """Families of effects and unknown causes to choose from."""
        return families(self.wide.effects, self.unknowns)

    def nats(self, key: Hypothesis) -> float:
        """Evidence of a set that was weighed."""
        return self.weighed[key].nats

    def fit_of(self, members: Members) -> Fit:
        """Fit of a set that was refitted."""
        fit = self.weighed[Hypothesis(members)].fit
        assert fit is not None  # sets without an unknown cause are fitted
        return fit

    def neighbors(self, members: Members) -> list[Members]:
        """Sets with one effect more, one less, or one swapped, or a masking pair more."""
        others = [i for i in range(len(self.wide.effects)) if i not in members]
        more = [members | {i} for i in others] if len(members) < self.settings.max_effects else []
        less = [members - {i} for i in members]
        swapped = [(members - {i}) | {j} for i in members for j in others]
        room = self.settings.max_effects - len(members)
        pairs = [members | pair for pair in masking_pairs(self.wide.effects, members, room)]
        return [s for s in (*more, *pairs, *less, *swapped) if self._lies_once(s)]

    def _lies_once(self, members: Members) -> bool:
        """Whether no two effects of a set share one place in time."""
        families = [e.family for i in members if (e := self.wide.effects[i]).locate is not None]
        return len(set(families)) == len(families)

    def linear_slack(self, members: Members) -> float:
        """Largest error of linear evidence at a set [nats]."""
        fit = self.fit_of(members)
        misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
        return self.settings.rival_nats + self.settings.linear_error * misfit

    def best_cost(self) -> float:
        """Half the lowest cost of all fits [nats]."""
        fits = [w.fit for w in self.weighed.values() if w.fit is not None]
        return 0.5 * min(f.chi2 + f.prior for f in fits)

    def with_fit(self, members: Members, fit: Fit) -> Search:
        """The search with the evidence of a fit, which needs the set's own columns only."""
        own = LaplaceEvidence(fit.problem, fit.x, fit.residual, fit.jacobian, [], self.num_families)
        weighed = own.weigh(Hypothesis(frozenset(range(len(members)))))
        nats, key = weighed.nats - unrealized(fit, weighed), Hypothesis(members)
        entry = replace(weighed, nats=nats, chi2=fit.chi2, fit=fit)
        linear = {h: w for h, w in self.linear.items() if h != key}
        return replace(self, weighed={**self.weighed, key: entry}, linear=linear)


def begin(null: Null, simulations: Simulations) -> Search:
    """The plain model weighed, everything linearized there.

    Args:
        null: The plain model under its noise floor.
        simulations: Simulations made so far, those of an earlier noise floor included.
    """
    at, made = simulations.under(null).screen(NONE, None)
    num_families = families(null.wide.effects, null.case.unknowns)
    return Search(null, made, made.center(NONE, at, num_families)).with_fit(NONE, null.fit)


def search_sets(search: Search) -> Search:
    """Weigh sets of effects until none of the best set's neighbors is better; then its rivals, and
    unknown causes beside it."""
    until = process_time() + search.settings.refit_seconds
    center, search = _from_data_sheet(search)
    if center is search.plain:
        center, search = _scanned(search, search.plain)
        search = replace(search, plain=center)
    for _ in range(search.settings.max_rounds):
        ranked, search = _promising(search, center)
        for k, members in enumerate(ranked[: search.settings.num_refits]):
            if k == 0 or process_time() < until:
                search = refit(search, members, center)
        search = repaired(search)
        best = max((h for h in search.weighed if h.unknown is None), key=search.nats).effects
        if best == center.members:
            break
        center, search = _center(search, best, center)
        if process_time() > until:
            break
    return _weigh_unknowns(repaired(_refit_rivals(search, center, until)), center)


def with_numerics(search: Search, members: Members) -> Search:
    """Check the numerical settings at the fit of a set, once; at that of the plain model they were
    checked before; those of corrected simulations are checked by their correction."""
    case = search.null.case
    accepted = case.settings.accept_numerics or case.correction is not None
    if accepted or members == NONE or members in search.numerics:
        return search
    record = search.simulations.fitted[members].record
    found = numerics_of(search.null, search.fit_of(members), record)
    return replace(search, numerics={**search.numerics, members: found})


def _from_data_sheet(search: Search) -> tuple[Center, Search]:
    """The plain model; or the best set that was fitted from the data sheet, if its fit has left
    that."""
    if not has_left(search.fit_of(NONE)):
        return search.plain, search
    sheet, made = center_at_sheet(search.simulations, search.settings, search.num_families)
    search = replace(search, simulations=made)
    if sheet is not None:
        ranked = promising_sets(sheet, search.settings.max_effects)
        settings = search.settings
        seconds = min(settings.scan_seconds, FROM_SHEET * settings.refit_seconds)
        until = process_time() + seconds
        for members, _ in ranked[: max(search.settings.num_refits, LEAST_REFITS)]:
            if process_time() < until:
                search = refit(search, members, sheet, begin=cooled)
    best = max((h for h in search.weighed if h.unknown is None), key=search.nats).effects
    return (search.plain, search) if best == NONE else _center(search, best, search.plain)


def refit(
    search: Search, members: Members, near: Center | None = None, *, begin: Begin | None = None
) -> Search:
    """Fit a set and weigh it there, once; recorded under ``failed`` where it cannot be simulated.

    Args:
        search: Sets that were weighed so far.
        members: Effects of the set, by index.
        near: Center to start from; the plain model if None, or if it cannot be simulated from
            there.
        begin: Finds where a fit begins, from a start of its own.
    """
    key = Hypothesis(members)
    if key in search.weighed or key in search.failed:
        return search
    names = " + ".join(search.wide.effects[i].name for i in sorted(members))
    # how many refits it will take is not known before: each takes a tenth of what is left
    share = 0.85 - 0.6 * 0.9 ** len(search.weighed)
    search.null.case.progress("search", share, names or "no effect")
    near = near or search.plain
    promised = 0.5 * _cost(near.weigh(members))
    message, best = "", None
    starts = _starts(search, members, near)
    begin = None if members in search.simulations.fitted else begin
    for center in starts if begin is None else starts[:1]:
        try:
            start = search.simulations.start(members, center.at, center.evidence.weigh(key).x)
            fit, at = search.simulations.fitted_from(members, start, search.best_cost(), begin)
        except DiffsimError as error:
            message = str(error)
            continue
        if best is None or fit.chi2 + fit.prior < best[0].chi2 + best[0].prior:
            best = fit, at
        if not _disappoints(search, best[0], promised):
            break
    if best is None:
        return replace(search, failed={**search.failed, key: message})
    made = search.simulations.kept(members, best[1])
    return replace(search, simulations=made).with_fit(members, best[0])


def _starts(search: Search, members: Members, near: Center) -> list[Center]:
    """Centers to start from: scanned sizes, the center itself, the plain model; the first that
    lead to a good end are enough."""
    if members in search.simulations.fitted:  # from its own earlier end
        return [near]
    places = (near.towards(members), near, search.plain.towards(members), search.plain)
    return list(dict.fromkeys(places))[: search.settings.num_starts]


def _disappoints(search: Search, fit: Fit, promised: float) -> bool:
    """Whether a fit ended far above what linear evidence promised, though that was of interest."""
    slack = search.settings.rival_nats
    if promised > search.best_cost() + slack:
        return False
    misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
    missed = 0.5 * (fit.chi2 + fit.prior) - promised
    return missed > slack + search.settings.linear_error * misfit


def _cost(weighed: Weighed) -> float:
    return weighed.chi2 + float(weighed.x @ weighed.x)


def repaired(search: Search) -> Search:
    """Sets that ended above one of their subsets are fitted again, from that one's optimum with the
    further sizes at zero."""
    for key in sorted((h for h in search.weighed if _is_fitted(search, h)), key=_size):
        subset = _better_subset(search, key.effects)
        if subset is None:
            continue
        made = search.simulations
        try:
            slopes = made.screened.get(subset, search.plain.at)
            start = replace(made.fitted[subset].joined(slopes), slope_error=BORROWED)
            fit, at = made.fitted_from(key.effects, start, search.best_cost())
        except DiffsimError as error:  # that end cannot be moved: what it is must be said
            search = replace(search, failed={**search.failed, key: str(error)})
            continue
        made = made.kept(key.effects, at)
        search = replace(search, simulations=made).with_fit(key.effects, fit)
    return search


def _better_subset(search: Search, members: Members) -> Members | None:
    """The best fitted subset, if the set's own fit is worse by more than fits are exact to."""
    subsets = [h for h in search.weighed if h.effects < members and _is_fitted(search, h)]
    if not subsets:
        return None
    costs = {h.effects: 0.5 * _fit_cost(search.fit_of(h.effects)) for h in subsets}
    best = min(costs, key=lambda s: costs[s])
    fit = search.fit_of(members)
    misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
    exact = max(WORSE_NATS, fit.problem.fit_rtol * misfit)
    return best if 0.5 * _fit_cost(fit) > costs[best] + exact else None


def _fit_cost(fit: Fit) -> float:
    return fit.chi2 + fit.prior


def _is_fitted(search: Search, key: Hypothesis) -> bool:
    return key.unknown is None and search.weighed[key].fit is not None


def _size(key: Hypothesis) -> int:
    return len(key.effects)


def weigh_unknowns_beside(search: Search, members: Members) -> Search:
    """Weigh a fitted set with every unknown cause, if that was not done."""
    if not search.unknowns or Hypothesis(members, 0) in search.weighed:
        return search
    center, search = _center(search, members, search.plain)
    return _weigh_unknowns(search, center)


def _center(search: Search, members: Members, last: Center) -> tuple[Center, Search]:
    borrowed = search.borrowed
    try:
        at, made = search.simulations.screen(members, last.at)
    except DiffsimError as error:  # some effect cannot be moved there: slopes of before
        made = search.simulations
        at = made.fitted[members].joined(last.at)
        borrowed = {**borrowed, members: str(error)}
    center = made.center(members, at, search.num_families)
    return _scanned(replace(search, simulations=made, borrowed=borrowed), center)


def _scanned(search: Search, center: Center) -> tuple[Center, Search]:
    """A center with the scans of effects with kinks, where a misfit is left for them."""
    fit, settings = search.fit_of(center.members), search.settings
    if 0.5 * (fit.chi2 - fit.num_samples) < SCAN_NATS:
        return center, search
    center, made = search.simulations.scanned(center, settings, search.num_families)
    return center, replace(search, simulations=made)


def _with_linear(
    search: Search, center: Center, sets: Sequence[Members]
) -> tuple[dict[Members, float], Search]:
    """Linear evidence of sets at a center [nats], kept for the table."""
    entries = {s: center.weigh(s) for s in sets}
    new = {Hypothesis(s): w for s, w in entries.items() if Hypothesis(s) not in search.weighed}
    nats = {s: w.nats for s, w in entries.items()}
    return nats, replace(search, linear={**search.linear, **new})


def _promising(search: Search, center: Center) -> tuple[list[Members], Search]:
    """Neighbors that could be better than the center, best first."""
    slack = search.linear_slack(center.members)
    enough = search.nats(Hypothesis(center.members)) + KEEP_NATS - slack
    nats, search = _with_linear(search, center, search.neighbors(center.members))
    return sorted((s for s in nats if nats[s] > enough), key=lambda s: -nats[s]), search


def _refit_rivals(search: Search, center: Center, until: float) -> Search:
    """Refit what could be a rival of the best set, or show that a member is not needed.

    Args:
        search: Sets that were weighed so far.
        center: The best set.
        until: CPU time after which the rest keeps its linear evidence, subsets apart [s].
    """
    slack = search.linear_slack(center.members)
    plain, best = search.nats(Hypothesis()), search.nats(Hypothesis(center.members))
    neighbors = search.neighbors(center.members)
    if np.isfinite(until):  # what could decide most comes first
        nats, search = _with_linear(search, center, neighbors)
        neighbors.sort(key=lambda s: (not s < center.members, -nats[s]))
    for members in neighbors:
        enough = best + KEEP_NATS if members > center.members else best - ALONE_NATS
        if members < center.members:
            enough = best - KEEP_NATS
        elif not members > center.members:
            enough = max(enough, plain + KEEP_NATS)
        nats, search = _with_linear(search, center, [members])
        if nats[members] > enough - slack:
            if process_time() > until and not members < center.members:
                search = replace(search, num_late=search.num_late + 1)
                continue
            search = refit(search, members, center)
    return search


def _weigh_unknowns(search: Search, center: Center) -> Search:
    """The best set and its subsets, each with every unknown cause, where the set was fitted."""
    places = {search.plain: [NONE]}
    places[center] = [center.members, *(center.members - {i} for i in center.members)]
    lies: dict[Hypothesis, LaplaceEvidence] = {}
    for place, sets in places.items():
        evidence, made = search.simulations.with_unknowns(
            place, search.unknowns, search.num_families
        )
        keys = [Hypothesis(s, u) for s in sets for u in range(len(search.unknowns))]
        new = {key: evidence for key in keys if key not in lies}  # the plain model comes first
        lies |= new
        weighed = {key: evidence.weigh(key) for key in new}
        search = replace(search, simulations=made, weighed={**search.weighed, **weighed})
    for key in sorted(lies, key=lambda h: -search.nats(h)):
        if _could_decide(search, key, center.members):
            search = _relinearized(search, key, lies[key])
    return search


def _could_decide(search: Search, key: Hypothesis, best: Members) -> bool:
    """Whether the verdict hangs on how exact this evidence is."""
    ahead, slack = search.nats(key) - search.nats(Hypothesis(best)), search.settings.rival_nats
    if key.effects >= best:
        return abs(ahead - KEEP_NATS) < slack
    return ahead > -ALONE_NATS


def _relinearized(search: Search, key: Hypothesis, evidence: LaplaceEvidence) -> Search:
    """A set with an unknown cause, linearized again at its own optimum.

    Where the last step was large, a simulation at its end says what it is worth, if less.
    """
    assert key.unknown is not None
    problem, cause = search.simulations.narrow(key.effects), search.unknowns[key.unknown]
    own = search.simulations.coordinates(key.effects)
    weighed, x0, last = search.weighed[key], evidence.x0, None
    try:
        for _ in range(search.settings.unknown_steps - 1):
            x = weighed.x[own]
            if np.abs(weighed.x - x0).max(initial=0.0) < STEP_ATOL:
                break
            last = linearization_at(problem, x), cause.responses(problem, x)
            x0, weighed = weighed.x, _weighed_beside(search, problem, *last, own)
        if last is not None and np.abs(weighed.x - x0).max(initial=0.0) > LONG_STEP:
            x = weighed.x[own]
            there = replace(last[0], x=x, record=record_at(problem, x))
            simulated = _weighed_beside(search, problem, there, last[1], own)
            weighed = min(weighed, simulated, key=lambda w: w.nats)
    except DiffsimError as error:  # the step left what can be simulated: keep the last
        search = replace(search, failed={**search.failed, key: str(error)})
    return replace(search, weighed={**search.weighed, key: weighed})


def _weighed_beside(
    search: Search, problem: Problem, at: Linearization, response: Array, own: list[int]
) -> Weighed:
    """Evidence of all effects of a problem with an unknown cause, in wide coordinates."""
    residual = whitened(problem, measured_of(problem) - at.record)
    jacobian = whitened(problem, at.columns) * problem.stretch(at.x)
    families, unknowns = search.num_families, len(search.unknowns)
    evidence = LaplaceEvidence(problem, at.x, residual, jacobian, [response], families, unknowns)
    narrow = evidence.weigh(Hypothesis(frozenset(range(len(problem.effects))), 0))
    wide = np.zeros((2, len(search.wide.names)))
    wide[:, own] = narrow.x, narrow.sd
    return replace(narrow, x=wide[0], sd=wide[1])
