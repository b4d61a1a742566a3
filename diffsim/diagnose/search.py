"""Refit and weigh: which set of effects, with or without an unknown cause, the runs ask for.

From the best set so far its neighbours (one more, one less, one swapped) are ranked by linear
evidence, those that could matter are refitted, and the best refit becomes the next centre, until
none is better. What is not refitted keeps its linear evidence, and cannot win.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.decide import ALONE_NATS, KEEP_NATS
from diffsim.diagnose.descend import Descended
from diffsim.diagnose.evidence import Hypothesis, Linearisation, Weighed, families, unrealised
from diffsim.diagnose.points import Members, Points
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import SearchSettings
from diffsim.identify.local import Local, local_at, measured_of, whitened
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
NONE: Members = frozenset()


@dataclass(frozen=True, eq=False)
class Entry:
    """A hypothesis that was weighed where it lies.

    Attributes:
        hypothesis: Which.
        weighed: Its evidence, at its own linearisation; with an unknown cause that is far from
            deciding, at that of its effects.
        fit: Of its effects; None with an unknown cause (``weighed.x`` says where it lies).
    """

    hypothesis: Hypothesis
    weighed: Weighed
    fit: Fit | None

    @property
    def nats(self) -> float:
        """Evidence."""
        return self.weighed.nats


@dataclass(frozen=True, eq=False)
class Centre:
    """A fitted set with everything linearised there."""

    members: Members
    local: Local
    linear: Linearisation


class Search:
    """Holds what was refitted (``entries``), what was only weighed linearly (``linear_only``), what
    could not be simulated (``failed``), and where slopes of an earlier centre had to serve
    (``borrowed``).

    Args:
        wide: Problem with all candidate effects.
        unknowns: Generic causes.
        null: Fit without effects.
        settings: Effort.
        before: Simulated in an earlier round with another noise floor.
        tell: Told the number of refits and the set that is next.
    """

    def __init__(
        self,
        wide: Problem,
        unknowns: Sequence[Unknown],
        null: Descended,
        settings: SearchSettings | None = None,
        before: Points | None = None,
        tell: Callable[[int, str], None] | None = None,
    ):
        self.wide, self.unknowns = wide, tuple(unknowns)
        self.settings = settings or SearchSettings()
        self.num_families = families(wide.effects, unknowns)
        self.points, self.tell = Points(wide, before), tell
        self.points.keep(NONE, null.local)
        self.entries: dict[Hypothesis, Entry] = {}
        self.linear_only: dict[Hypothesis, Weighed] = {}
        self.failed: dict[Hypothesis, str] = {}
        self.borrowed: dict[Members, str] = {}
        self._enter(NONE, null.fit)
        self._null = self._centre(NONE, None)

    @property
    def null_linear(self) -> Linearisation:
        """Everything linearised at the plain model."""
        return self._null.linear

    def run(self) -> None:
        """Fill ``entries``."""
        centre = self._null
        for _ in range(self.settings.max_rounds):
            for members in self._promising(centre)[: self.settings.num_refits]:
                self.refit(members, centre)
            best = max((h for h in self.entries if h.unknown is None), key=self._nats).effects
            if best == centre.members:
                break
            centre = self._centre(best, centre)
        self._rivals(centre)
        self._unknowns(centre)

    def neighbours(self, members: Members) -> list[Members]:
        """Sets with one effect more, one less, or one swapped."""
        others = [i for i in range(len(self.wide.effects)) if i not in members]
        more = [members | {i} for i in others] if len(members) < self.settings.max_effects else []
        less = [members - {i} for i in members]
        swapped = [(members - {i}) | {j} for i in members for j in others]
        return [*more, *less, *swapped]

    def refit(self, members: Members, near: Centre | None = None) -> Entry | None:
        """Fit a set, weigh it there; once. None where it cannot be simulated.

        Args:
            members: The set.
            near: Where to begin; the plain model if None, or if it cannot be simulated from there.
        """
        key = Hypothesis(members)
        if key in self.entries or key in self.failed:
            return self.entries.get(key)
        if self.tell is not None:
            names = " + ".join(self.wide.effects[i].name for i in sorted(members))
            self.tell(len(self.entries), names or "no effect")
        message = ""
        for centre in dict.fromkeys((near or self._null, self._null)):
            try:
                start = self.points.start(members, centre.local, centre.linear.weigh(key).x)
                found = self.points.descend(members, start, self._half_cost)
            except DiffsimError as error:
                message = str(error)
                continue
            self.linear_only.pop(key, None)
            return self._enter(members, found.fit)
        self.failed[key] = message
        return None

    def face_unknowns(self, members: Members) -> None:
        """Weigh a fitted set with every unknown cause, if that was not done."""
        if self.unknowns and Hypothesis(members, 0) not in self.entries:
            self._unknowns(self._centre(members, self._null))

    def responses(self, members: Members, unknown: int) -> Array:
        """Whitened responses of an unknown cause at the fit of a set."""
        local = self.points.fitted[members]
        return self.points.responses(self.unknowns[unknown], unknown, members, local)

    def _enter(self, members: Members, fit: Fit) -> Entry:
        """The Laplace evidence needs the set's own columns only."""
        own = Linearisation(fit.problem, fit.x, fit.residual, fit.jacobian, [], self.num_families)
        weighed = own.weigh(Hypothesis(frozenset(range(len(members)))))
        key = Hypothesis(members)
        nats = weighed.nats - unrealised(fit, weighed)
        self.entries[key] = Entry(key, replace(weighed, nats=nats, chi2=fit.chi2), fit)
        return self.entries[key]

    def _centre(self, members: Members, last: Centre | None) -> Centre:
        if last is None:
            local = self.points.screen(members, None)
        else:
            try:
                local = self.points.screen(members, last.local)
            except DiffsimError as error:  # some effect cannot be moved there: slopes of before
                local = self.points.fitted[members].joined(last.local)
                self.borrowed[members] = str(error)
        return Centre(members, local, self._linear(members, local, ()))

    def _linear(self, members: Members, local: Local, unknowns: Sequence[Unknown]) -> Linearisation:
        return self.points.linear(members, local, unknowns, self.num_families)

    def _weigh(self, centre: Centre, members: Members) -> float:
        """Linear evidence, noted for the table."""
        key = Hypothesis(members)
        weighed = centre.linear.weigh(key)
        if key not in self.entries:
            self.linear_only[key] = weighed
        return weighed.nats

    def _promising(self, centre: Centre) -> list[Members]:
        """Neighbours that could be better than the centre, best first."""
        enough = self._nats(Hypothesis(centre.members)) + KEEP_NATS - self._slack(centre.members)
        nats = {s: self._weigh(centre, s) for s in self.neighbours(centre.members)}
        return sorted((s for s in nats if nats[s] > enough), key=lambda s: -nats[s])

    def _rivals(self, centre: Centre) -> None:
        """Refit what could be a rival of the best set, or show that a member is not needed."""
        slack = self._slack(centre.members)
        plain, best = self._nats(Hypothesis()), self._nats(Hypothesis(centre.members))
        for members in self.neighbours(centre.members):
            enough = best + KEEP_NATS if members > centre.members else best - ALONE_NATS
            if members < centre.members:
                enough = best - KEEP_NATS
            elif not members > centre.members:
                enough = max(enough, plain + KEEP_NATS)
            if self._weigh(centre, members) > enough - slack:
                self.refit(members, centre)

    def _unknowns(self, centre: Centre) -> None:
        """The best set and its subsets, each with every unknown cause, where the set was fitted."""
        places = {self._null: [NONE]}
        places[centre] = [centre.members, *(centre.members - {i} for i in centre.members)]
        lies: dict[Hypothesis, Linearisation] = {}
        for place, sets in places.items():
            linear = self._linear(place.members, place.local, self.unknowns)
            keys = [Hypothesis(s, u) for s in sets for u in range(len(self.unknowns))]
            for key in keys:
                if key not in lies:  # the plain model's own place comes first
                    lies[key] = linear
                    self.entries[key] = Entry(key, linear.weigh(key), None)
        for key in sorted(lies, key=lambda h: -self._nats(h)):
            if self._could_decide(key, centre.members):
                self._refine(key, lies[key])

    def _could_decide(self, key: Hypothesis, best: Members) -> bool:
        """Whether the verdict hangs on how exact this evidence is."""
        ahead, slack = self._nats(key) - self._nats(Hypothesis(best)), self.settings.rival_nats
        if key.effects >= best:
            return abs(ahead - KEEP_NATS) < slack
        return ahead > -ALONE_NATS

    def _refine(self, key: Hypothesis, linear: Linearisation) -> None:
        """Linearise a set with an unknown cause again where it lies."""
        assert key.unknown is not None
        problem, cause = self.points.narrow(key.effects), self.unknowns[key.unknown]
        own = self.points.coordinates(key.effects)
        weighed, x0 = self.entries[key].weighed, linear.x0
        everything = Hypothesis(frozenset(range(len(key.effects))), 0)
        for _ in range(self.settings.unknown_steps - 1):
            x = weighed.x[own]
            if np.abs(weighed.x - x0).max(initial=0.0) < 0.05:
                break
            try:
                local = local_at(problem, x)
                response = cause.responses(problem, x)
            except DiffsimError as error:  # the step left what can be simulated: keep the last
                self.failed[key] = str(error)
                break
            residual = whitened(problem, measured_of(problem) - local.record)
            jacobian = whitened(problem, local.columns)
            again = Linearisation(
                problem, x, residual, jacobian, [response], self.num_families, len(self.unknowns)
            )
            found = again.weigh(everything)
            x0, wide = weighed.x, np.zeros((2, len(self.wide.names)))
            wide[:, own] = found.x, found.sd
            weighed = replace(found, x=wide[0], sd=wide[1])
        self.entries[key] = Entry(key, weighed, None)

    def _slack(self, members: Members) -> float:
        """By how many nats linear evidence at a set may be wrong."""
        fit = self.entries[Hypothesis(members)].fit
        assert fit is not None
        misfit = 0.5 * max(fit.chi2 - fit.num_samples, 0.0)
        return self.settings.rival_nats + self.settings.misled * misfit

    def _half_cost(self) -> float:
        fits = [e.fit for e in self.entries.values() if e.fit is not None]
        return 0.5 * min(f.chi2 + f.prior for f in fits)

    def _nats(self, key: Hypothesis) -> float:
        return self.entries[key].nats
