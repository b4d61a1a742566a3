"""Sets of effects that a search has weighed, with or without an unknown cause."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from diffsim.diagnose.checks.refine import SetNumerics
from diffsim.diagnose.search.evidence import (
    Hypothesis,
    LaplaceEvidence,
    Weighed,
    families,
    unrealized,
)
from diffsim.diagnose.search.fit import Null
from diffsim.diagnose.search.scan import masking_pairs
from diffsim.diagnose.search.simulations import Center, Members, Simulations
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import SearchSettings
from diffsim.identify.unknown import Unknown


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
