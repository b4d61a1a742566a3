"""Sets of effects that a search has weighed; evidence beside an unknown cause of any course."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.checks.numerics import SetNumerics
from diffsim.diagnose.search.evidence import (
    ALONE_NATS,
    Hypothesis,
    LaplaceEvidence,
    SetPosterior,
    families,
    unrealized,
)
from diffsim.diagnose.search.fit import Null
from diffsim.diagnose.search.scan import masking_pairs
from diffsim.diagnose.search.simulations import NONE, Center, Members, Simulations
from diffsim.identify import Fit, Problem
from diffsim.identify.bandwidth import num_cosines_of
from diffsim.identify.effort import KEEP_NATS, SearchSettings
from diffsim.identify.linearization import Linearization, linearization_at
from diffsim.identify.model import slopes_are_simulated
from diffsim.identify.unknown import Unknown


@dataclass(frozen=True, eq=False)
class Search:
    """Sets that were weighed so far; every step returns a copy with what it adds."""

    null: Null  # the plain model under its noise floor
    simulations: Simulations  # fits and slopes behind the evidence
    plain: Center  # the plain model as a center
    # refitted sets, and sets with an unknown cause, at their own linearization where the verdict
    # hangs on it
    posteriors: Mapping[Hypothesis, SetPosterior] = field(default_factory=dict)
    # sets that have linear evidence only
    linear: Mapping[Hypothesis, SetPosterior] = field(default_factory=dict)
    # why a set could not be simulated
    failed: Mapping[Hypothesis, str] = field(default_factory=dict)
    # why slopes of an earlier center serve at a set
    borrowed: Mapping[Members, str] = field(default_factory=dict)
    num_late: int = 0  # sets that keep their linear evidence, or none, as a budget was spent
    # numerical settings at sets where they were checked
    numerics: Mapping[Members, SetNumerics] = field(default_factory=dict)
    # count of weighted steps at which what follows the last set ends: repairs, unknown causes and
    # exact ends share one more budget; infinite while sets are sought
    ends: float = np.inf
    # sets that were fitted on until their slopes were right, by ``fitted_exactly``
    exact: frozenset[Members] = frozenset()

    @property
    def is_cut_short(self) -> bool:
        """Whether a budget ended it or the plain model's fit, or coarse simulations stand for finer
        ones but at the answer: what it names is likely at most."""
        is_coarse = self.null.case.correction is not None and self.null.case.beyond is None
        is_late = self.num_late > 0 or self.null.fit.ended == "budget"
        return is_late or bool(self.simulations.scans_late) or is_coarse

    @property
    def steps(self) -> int:
        """Weighted steps that were simulated so far."""
        return self.wide.model.simulations.steps

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
        return self.posteriors[key].nats

    def fit_of(self, members: Members) -> Fit:
        """Fit of a set that was refitted."""
        fit = self.posteriors[Hypothesis(members)].fit
        assert fit is not None  # sets without an unknown cause are fitted
        return fit

    @property
    def fits(self) -> dict[Members, Fit]:
        """Fits of all sets that were refitted, without an unknown cause."""
        return {h.effects: w.fit for h, w in self.posteriors.items() if w.fit is not None}

    def neighbors(self, members: Members) -> list[Members]:
        """Sets with one effect more, one less, or one swapped, or a masking pair more."""
        others = [i for i in range(len(self.wide.effects)) if i not in members]
        more = [members | {i} for i in others] if len(members) < self.settings.max_effects else []
        less = [members - {i} for i in members]
        swapped = [(members - {i}) | {j} for i in members for j in others]
        room = self.settings.max_effects - len(members)
        pairs = [members | pair for pair in masking_pairs(self.wide.effects, members, room)]
        # no two effects of a set share one place in time
        located = {i: e.family for i, e in enumerate(self.wide.effects) if e.locate is not None}
        every, placed = (*more, *pairs, *less, *swapped), located.keys()
        return [s for s in every if len({located[i] for i in s & placed}) == len(s & placed)]

    def linear_slack(self, members: Members) -> float:
        """Largest error of linear evidence at a set [nats]."""
        fit = self.fit_of(members)
        misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
        return self.settings.rival_nats + self.settings.linear_error * misfit

    def best_cost(self) -> float:
        """Half the lowest cost of all fits [nats]."""
        return 0.5 * min(f.chi2 + f.prior for f in self.fits.values())

    def nats_moved(self, members: Members, change: NDArray[np.float64]) -> float:
        """Evidence of a fitted set if its records differed by a change, (N,), by its slopes."""
        fit, every = self.fit_of(members), Hypothesis(frozenset(range(len(members))))
        moved = fit.residual - fit.problem.whiten_all(change)
        before, after = (
            LaplaceEvidence(fit.problem, fit.x, r, fit.jacobian, [], self.num_families).weigh(every)
            for r in (fit.residual, moved)
        )
        return self.nats(Hypothesis(members)) + after.nats - before.nats

    def with_late(self) -> Search:
        """The search with one more set that nobody fitted, as a budget was spent."""
        return replace(self, num_late=self.num_late + 1)

    def with_failed(self, key: Hypothesis, why: str) -> Search:
        """The search with a set that cannot be simulated where it ends: what it is must be said."""
        return replace(self, failed={**self.failed, key: why})

    def with_fit(self, members: Members, fit: Fit) -> Search:
        """The search with the evidence of a fit, which needs the set's own columns only."""
        own = LaplaceEvidence(fit.problem, fit.x, fit.residual, fit.jacobian, [], self.num_families)
        posterior = own.weigh(Hypothesis(frozenset(range(len(members)))))
        nats, key = posterior.nats - unrealized(fit, posterior), Hypothesis(members)
        entry = replace(posterior, nats=nats, chi2=fit.chi2, fit=fit)
        linear = {h: w for h, w in self.linear.items() if h != key}
        return replace(self, posteriors={**self.posteriors, key: entry}, linear=linear)


Array = NDArray[np.float64]
STEP_ATOL = 0.05  # prior sd: a smaller step needs no simulation at its end


def weigh_unknowns(search: Search, center: Center) -> Search:
    """The best set and its subsets, each with every unknown cause, where the set was fitted."""
    if all(h.unknown is None for h in search.posteriors):
        search = _suit_unknowns(search, center)
    places = {search.plain: [NONE]}
    places[center] = [center.members, *(center.members - {i} for i in center.members)]
    lies: dict[Hypothesis, tuple[Center, LaplaceEvidence]] = {}
    for place, sets in places.items():
        evidence, made = search.simulations.with_unknowns(
            place, search.unknowns, search.num_families
        )
        keys = [Hypothesis(s, u) for s in sets for u in range(len(search.unknowns))]
        # the plain model comes first
        new = {key: (place, evidence) for key in keys if key not in lies}
        lies |= new
        posteriors = {key: evidence.weigh(key) for key in new}
        search = replace(search, simulations=made, posteriors={**search.posteriors, **posteriors})
    for key in sorted(lies, key=lambda h: -search.nats(h)):
        place, evidence = lies[key]
        if search.steps >= search.ends and _could_decide(search, key, center.members):
            search = search.with_late()
            continue
        if _could_decide(search, key, center.members):
            search = _simulated_beside(search, key, place, center.members)
        if _could_decide(search, key, center.members):
            search = relinearized(search, key, evidence)
    return search


def _suit_unknowns(search: Search, center: Center) -> Search:
    """Unknown causes as fast as what the plain model or the best set leaves, for all sets alike."""
    wanted = max(
        num_cosines_of(search.wide, place.evidence.residual) for place in (search.plain, center)
    )
    suited = tuple(unknown.suited(wanted) for unknown in search.unknowns)
    made = search.simulations
    kept = {
        key: slopes
        for key, slopes in made.unknown_slopes.items()
        if suited[key[1]] is search.unknowns[key[1]]
    }
    case = replace(search.null.case, unknowns=suited)
    null, made = replace(search.null, case=case), replace(made, unknown_slopes=kept)
    return replace(search, null=null, simulations=made)


def _could_decide(search: Search, key: Hypothesis, best: Members) -> bool:
    """Whether the verdict hangs on how exact this evidence is; a set that was fitted last may have
    more of it than the center."""
    nats, slack = search.nats(key), search.settings.rival_nats
    if key.effects >= best:
        return abs(nats - search.nats(Hypothesis(best)) - KEEP_NATS) < slack
    return nats > max(search.nats(h) for h in search.posteriors if h.unknown is None) - ALONE_NATS


def _simulated_beside(search: Search, key: Hypothesis, place: Center, best: Members) -> Search:
    """A set with an unknown cause, weighed by a simulation where linear evidence leads, if that
    leaves it no chance: where all slopes take simulations of their own, one tells first.
    """
    if not slopes_are_simulated(search.wide.model) or key.effects >= best:
        return search
    assert key.unknown is not None
    made, cause = search.simulations, search.unknowns[key.unknown]
    own = made.coordinates(key.effects)
    response, _ = made.responses(cause, key.unknown, place.members, place.at)
    try:
        at, search = _record_set(search, key.effects, search.posteriors[key].x[own])
    except DiffsimError:  # slopes may still be simulated on the way there
        return search
    there = replace(at, idx=tuple(range(len(own))), columns=place.at.slopes(own))
    found = _weigh_beside(search, made.narrow(key.effects), there, response, own)
    chance = search.nats(Hypothesis(best)) - ALONE_NATS - search.linear_slack(best)
    if found.nats >= chance:
        return search
    return replace(search, posteriors={**search.posteriors, key: found})


def relinearized(search: Search, key: Hypothesis, evidence: LaplaceEvidence) -> Search:
    """A set with an unknown cause, linearized again at its own optimum.

    Where the last step was not the end, a simulation there says what it is worth, if less.
    """
    assert key.unknown is not None
    problem, cause = search.simulations.narrow(key.effects), search.unknowns[key.unknown]
    own = search.simulations.coordinates(key.effects)
    posterior, x0, last = search.posteriors[key], evidence.x0[own], None
    try:
        for _ in range(search.settings.unknown_steps - 1):
            is_there = np.abs(posterior.x[own] - x0).max(initial=0.0) < STEP_ATOL
            if is_there or search.steps >= search.ends:
                break
            at, search = _linearize_set(search, key.effects, posterior.x[own])
            last = at, cause.responses(problem, at.x)
            x0, posterior = at.x, _weigh_beside(search, problem, *last, own)
        if last is not None and np.abs(posterior.x[own] - x0).max(initial=0.0) > STEP_ATOL:
            at, search = _record_set(search, key.effects, posterior.x[own])
            there = replace(last[0], x=at.x, record=at.record)
            simulated = _weigh_beside(search, problem, there, last[1], own)
            posterior = min(posterior, simulated, key=lambda w: w.nats)
    except DiffsimError as error:  # the step left what can be simulated: keep the last
        search = search.with_failed(key, str(error))
    return replace(search, posteriors={**search.posteriors, key: posterior})


def _linearize_set(search: Search, members: Members, x: Array) -> tuple[Linearization, Search]:
    """A set at a point, or as near as makes no difference where another cause has led."""
    made = search.simulations
    at = made.near(members, x, STEP_ATOL)
    if at is None or len(at.idx) < len(x):
        at = linearization_at(made.narrow(members), x)
        search = replace(search, simulations=made.noted(members, at))
    return at, search


def _record_set(search: Search, members: Members, x: Array) -> tuple[Linearization, Search]:
    """The same without slopes."""
    made = search.simulations
    at = made.near(members, x, STEP_ATOL)
    if at is None:
        record = made.narrow(members).record(x)
        at = Linearization(x, record, (), np.zeros((len(record), 0)))
        search = replace(search, simulations=made.noted(members, at))
    return at, search


def _weigh_beside(
    search: Search, problem: Problem, at: Linearization, response: Array, own: list[int]
) -> SetPosterior:
    """Evidence of all effects of a problem with an unknown cause, in wide coordinates."""
    residual = problem.residual_of(at.record)
    jacobian = problem.whiten_all(at.columns) * problem.stretch(at.x)
    families, unknowns = search.num_families, len(search.unknowns)
    evidence = LaplaceEvidence(problem, at.x, residual, jacobian, [response], families, unknowns)
    narrow = evidence.weigh(Hypothesis(frozenset(range(len(problem.effects))), 0))
    wide = np.zeros((2, len(search.wide.names)))
    wide[:, own] = narrow.x, narrow.sd
    return replace(narrow, x=wide[0], sd=wide[1])
