"""Refit and weigh: which set of effects, with or without an unknown cause, the runs ask for.

From the best set so far everything is linearised again; its neighbours (one more, one less, one
swapped) are ranked by linear evidence, the best are refitted, and the best refit becomes the next
centre, until none is better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffsim.diagnose.effect import Effect
from diffsim.diagnose.evidence import Hypothesis, Linearisation, Weighed, families
from diffsim.diagnose.unknown import Unknown
from diffsim.errors import DiffsimError
from diffsim.identify import Fit, Problem
from diffsim.identify import fit as fit_runs
from diffsim.identify.fitting import posterior_covariance

Array = NDArray[np.float64]
NOT_YET = -np.inf


@dataclass(frozen=True)
class SearchSettings:
    """Effort.

    Attributes:
        max_effects: In one set.
        num_refits: Neighbours refitted per round.
        max_rounds: Of re-linearising.
        rival_nats: Swaps whose linear evidence is at most this far behind are refitted at the end.
        unknown_steps: Gauss-Newton steps of a set together with an unknown cause.
    """

    max_effects: int = 3
    num_refits: int = 4
    max_rounds: int = 8
    rival_nats: float = 10.0
    unknown_steps: int = 3


@dataclass(frozen=True, eq=False)
class Entry:
    """A hypothesis that was refitted.

    Attributes:
        hypothesis: Which.
        weighed: Its evidence, at its own linearisation.
        fit: Of its effects; None with an unknown cause (``weighed.x`` says where it lies).
    """

    hypothesis: Hypothesis
    weighed: Weighed
    fit: Fit | None

    @property
    def nats(self) -> float:
        """Evidence."""
        return self.weighed.nats


class Search:
    """Holds what was refitted (``entries``) and what could not be simulated (``failed``).

    Args:
        wide: Problem with all candidate effects.
        unknowns: Generic causes.
        null: Fit without effects.
        settings: Effort.
    """

    def __init__(
        self,
        wide: Problem,
        unknowns: Sequence[Unknown],
        null: Fit,
        settings: SearchSettings | None = None,
    ):
        self.wide, self.unknowns = wide, tuple(unknowns)
        self.settings = settings or SearchSettings()
        self.num_families = families(wide.effects, unknowns)
        self.entries: dict[Hypothesis, Entry] = {}
        self.failed: dict[Hypothesis, str] = {}
        self.null_linear = self.linearise(self._widened(null))
        weighed = self.null_linear.weigh(Hypothesis())
        weighed = replace(weighed, nats=weighed.nats - unrealised(null))
        self.entries[Hypothesis()] = Entry(Hypothesis(), weighed, null)
        self._centres: dict[frozenset[int], Linearisation] = {frozenset(): self.null_linear}

    def run(self) -> None:
        """Fill ``entries``."""
        centre: frozenset[int] = frozenset()
        for _ in range(self.settings.max_rounds):
            linear = self.linear_at(centre)
            ranked = sorted(
                self.neighbours(centre), key=lambda s: -linear.weigh(Hypothesis(s)).nats
            )
            for members in ranked[: self.settings.num_refits]:
                self.refit(members, start=linear.weigh(Hypothesis(members)).x)
            best = max((h for h in self.entries if h.unknown is None), key=self._nats)
            if best.effects == centre:
                break
            centre = best.effects
        self._rivals(centre)
        self._unknowns(centre)

    def neighbours(self, members: frozenset[int]) -> list[frozenset[int]]:
        """Sets with one effect more, one less, or one swapped."""
        others = [i for i in range(len(self.wide.effects)) if i not in members]
        more = [members | {i} for i in others] if len(members) < self.settings.max_effects else []
        less = [members - {i} for i in members]
        swapped = [(members - {i}) | {j} for i in members for j in others]
        return [*more, *less, *swapped]

    def refit(self, members: frozenset[int], start: Array | None = None) -> Entry | None:
        """Fit a set, linearise at the answer, weigh; once. None where it cannot be simulated."""
        key = Hypothesis(members)
        if key in self.entries:
            return self.entries[key]
        if key in self.failed:
            return None
        found = self._fit(members, start)
        if found is None:
            return None
        # the Laplace evidence needs the set's own columns only: no second linearisation
        own = OwnLinearisation(found, self.num_families)
        self.entries[key] = Entry(key, own.weigh_all(len(members)), found)
        return self.entries[key]

    def _fit(self, members: frozenset[int], start: Array | None) -> Fit | None:
        """From ``start``, or from the prior where that cannot be simulated."""
        starts = [None] if start is None else [self._narrowed(start, members), None]
        for x0 in starts:
            try:
                return fit_runs(
                    self.wide.model,
                    self.wide.runs,
                    (),
                    effects=self._chosen(members),
                    start=x0,
                    whitener=self.wide.whitener,
                    jacobian=self.wide.jacobian,
                    workers=self.wide.workers,
                )
            except DiffsimError as error:
                self.failed[Hypothesis(members)] = str(error)
        return None

    def linear_at(self, members: frozenset[int]) -> Linearisation:
        """Everything linearised at the refit of a set."""
        if members not in self._centres:
            entry = self.refit(members)
            assert entry is not None and entry.fit is not None  # callers have seen it succeed
            self._centres[members] = self.linearise(self._widened(entry.fit))
        return self._centres[members]

    def linearise(self, x: Array) -> Linearisation:
        """All effects and unknown causes at coordinates of the wide problem."""
        return Linearisation(self.wide, x, self.unknowns, self.num_families)

    def _rivals(self, centre: frozenset[int]) -> None:
        """Refit everything near the best set that could be a rival, and its members' removal."""
        linear = self.linear_at(centre)
        best = self._nats(Hypothesis(centre))
        for members in self.neighbours(centre):
            weighed = linear.weigh(Hypothesis(members))
            is_less = members < centre
            if is_less or weighed.nats > best - self.settings.rival_nats:
                self.refit(members, start=weighed.x)

    def _unknowns(self, centre: frozenset[int]) -> None:
        """The best set and its subsets, each with every unknown cause."""
        sets = {centre, frozenset(), *(centre - {i} for i in centre)}
        for members in sets:
            if self.refit(members) is None:
                continue
            for u in range(len(self.unknowns)):
                self._with_unknown(Hypothesis(members, u))

    def _with_unknown(self, key: Hypothesis) -> None:
        linear = self.linear_at(key.effects)
        weighed = linear.weigh(key)
        for _ in range(self.settings.unknown_steps - 1):
            x = weighed.x
            if np.abs(x - linear.x0).max(initial=0.0) < 0.05:
                break
            try:
                linear = self.linearise(x)
            except DiffsimError as error:  # the step left what can be simulated: keep the last
                self.failed[key] = str(error)
                break
            weighed = linear.weigh(key)
        self.entries[key] = Entry(key, weighed, None)

    def _chosen(self, members: frozenset[int]) -> tuple[Effect, ...]:
        return tuple(self.wide.effects[i] for i in sorted(members))

    def _widened(self, fit: Fit) -> Array:
        x = np.zeros(len(self.wide.names))
        x[: self.wide.num_base] = fit.x[: self.wide.num_base]
        for effect in fit.problem.effects:
            x[self.wide.columns_of(effect)] = fit.x[fit.problem.columns_of(effect)]
        return x

    def _narrowed(self, x: Array, members: frozenset[int]) -> Array:
        idx = list(range(self.wide.num_base))
        for i in sorted(members):
            idx += self.wide.columns_of(self.wide.effects[i])
        return x[idx]

    def _nats(self, key: Hypothesis) -> float:
        return self.entries[key].nats


class OwnLinearisation(Linearisation):
    """The linearisation that a fit already holds, of its own columns."""

    def __init__(self, fit: Fit, num_families: int):
        self.fit, self.problem, self.x0, self.num_families = fit, fit.problem, fit.x, num_families
        self.residual, self.jacobian = fit.residual, fit.jacobian
        self._from_matrices(fit.residual + fit.jacobian @ fit.x, fit.jacobian, [])
        self.columns = [fit.problem.columns_of(e) for e in fit.problem.effects]

    def weigh_all(self, count: int) -> Weighed:
        """Evidence of the fit with all its effects."""
        weighed = self.weigh(Hypothesis(frozenset(range(count))))
        nats = weighed.nats - unrealised(self.fit)
        return replace(weighed, nats=nats, chi2=float(self.residual @ self.residual))


def unrealised(fit: Fit) -> float:
    """Nats that a Gauss-Newton step from a fit promises but the fit did not find.

    The evidence from a linearisation holds at its optimum; a fit that stopped elsewhere (a kink, a
    fold, too few steps) must not be credited with an optimum that nobody has seen.
    """
    free = [i for i, n in enumerate(fit.problem.names) if n not in fit.at_bound]
    j = fit.jacobian[:, free]
    slope = j.T @ fit.residual - fit.x[free]
    return 0.5 * float(slope @ posterior_covariance(j) @ slope)
