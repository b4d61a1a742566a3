"""Simulations of sets of effects, kept between rounds and processes.

Coordinates are those of the wide problem, with all candidates: base parameters, then components of
all effects, zero for those not in the set. Nothing here depends on the noise floor but the slopes
that a fit's Broyden updates have changed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from diffsim.core.errors import DiffsimError
from diffsim.core.memo import SpilledArray, spill
from diffsim.diagnose.search.evidence import Hypothesis, LaplaceEvidence, SetPosterior
from diffsim.diagnose.search.fit import Null
from diffsim.diagnose.search.gauss_newton import gauss_newton, unfitted_shapes
from diffsim.diagnose.search.located import course_at, scan_located
from diffsim.diagnose.search.scan import Scan, first_runs, groups, num_points, run_for_scans, scan
from diffsim.diagnose.search.store import Arrays, Store, gauss_newton_kept, packed, unpacked
from diffsim.diagnose.search.weak_slopes import descended, mended, stepped
from diffsim.identify import Fit, Problem
from diffsim.identify.effect import Effect, Locator
from diffsim.identify.effort import SearchSettings
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.linearization import Linearization, linearization_at
from diffsim.identify.locate import Course
from diffsim.identify.model import slopes_are_simulated
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
Members = frozenset[int]
NONE: Members = frozenset()
ALIKE = 0.9  # cosine with a member above which slopes are simulated again


@dataclass(frozen=True, eq=False)
class Center:
    """A fitted set with every candidate linearized there.

    Attributes:
        members: Effects of the set, by index.
        at: Linearization in wide coordinates, with all slopes.
        evidence: Linear evidence of all neighbors, without unknown causes.
        scanned: Centers at the best sizes of groups of effects outside the set, by group.
    """

    members: Members
    at: Linearization
    evidence: LaplaceEvidence
    scanned: Mapping[Members, Center] = field(default_factory=dict)

    def towards(self, members: Members) -> Center:
        """Where a fit of a set starts: here, or at the sizes that were scanned of what it adds or
        of a part of that, as linear evidence has it: beside a large size of one cause another one
        promises what it does there, not what it does at zero."""
        added = members - self.members
        places = [self, *(at for group, at in self.scanned.items() if group <= added)]
        if len(places) == 1:
            return self
        return max(places, key=lambda at: at.evidence.weigh(Hypothesis(members)).nats)

    def weigh(self, members: Members) -> SetPosterior:
        """Linear evidence of a set, from where its fit starts."""
        return self.towards(members).evidence.weigh(Hypothesis(members))


@dataclass(frozen=True, eq=False)
class Simulations:
    """Fits and slopes of sets of effects; methods return a copy with what they simulated."""

    wide: Problem  # problem with all candidate effects
    # results on disk, of this and earlier processes; None: nothing is kept
    store: Store | None = None
    # linearization of each refitted set where its fit ended
    fitted: Mapping[Members, Linearization] = field(default_factory=dict)
    # linearization of each set with the slopes of all candidates
    screened: Mapping[Members, Linearization] = field(default_factory=dict)
    # slopes of an unknown cause at the fit of a set, (N, k), by set and index of the cause
    unknown_slopes: Mapping[tuple[Members, int], SpilledArray] = field(default_factory=dict)
    # where sets with an unknown cause have their optimum, in the coordinates of ``narrow``:
    # simulations serve every unknown cause, as only its response differs
    at_unknowns: Mapping[Members, tuple[Linearization, ...]] = field(default_factory=dict)
    # sizes that were tried, by members of the center and group of effects
    scans: Mapping[tuple[Members, Members], Scan] = field(default_factory=dict)
    scan_steps: int = 0  # weighted steps that these took
    # groups of effects that were not tried because a budget was spent; where, by ``place`` and
    # members of the center
    scans_late: frozenset[tuple[str, Members, Members]] = frozenset()
    # all slopes of the plain model at its prior, where they were asked for
    at_prior: Linearization | None = None
    # sizes that were tried there
    prior_scans: Mapping[tuple[Members, Members], Scan] = field(default_factory=dict)
    place: str = ""  # where the plain model is, for what is kept on disk; empty: at its fit

    def under(self, null: Null) -> Simulations:
        """The same simulations for another fit of the plain model or another noise floor."""
        return replace(self, wide=null.wide).kept(NONE, null.at)

    def moved(
        self, null: Null, of: Callable[[Linearization], Linearization], store: Store | None
    ) -> Simulations:
        """The same under another correction.

        Args:
            null: Fit of the plain model under it.
            of: Carries a linearization there.
            store: Where results under this correction are kept.
        """

        def tried(scans: Mapping[tuple[Members, Members], Scan]) -> Mapping[Any, Scan]:
            return {k: s if s.at is None else replace(s, at=of(s.at)) for k, s in scans.items()}

        made = replace(
            self,
            store=store,
            fitted={k: of(at) for k, at in self.fitted.items()},
            screened={k: of(at) for k, at in self.screened.items()},
            at_unknowns={k: tuple(of(at) for at in v) for k, v in self.at_unknowns.items()},
            scans=tried(self.scans),
            at_prior=None if self.at_prior is None else of(self.at_prior),
            prior_scans=tried(self.prior_scans),
        )
        return made.under(null)

    def coordinates(self, members: Members) -> list[int]:
        """Wide coordinates of the base parameters and of a set."""
        own = list(range(self.wide.num_base))
        for i in sorted(members):
            own += self.wide.columns_of(self.wide.effects[i])
        return own

    def narrow(self, members: Members) -> Problem:
        """Problem with the effects of a set only."""
        return replace(self.wide, effects=tuple(self.wide.effects[i] for i in sorted(members)))

    def kept(self, members: Members, at: Linearization) -> Simulations:
        """The simulations with the fit of a set, given in the coordinates of ``narrow``."""
        own = self.coordinates(members)
        x = np.zeros(len(self.wide.names))
        x[own] = at.x
        wide = replace(at, x=x, idx=tuple(own))
        return replace(self, fitted={**self.fitted, members: wide})

    def fitted_from(
        self,
        members: Members,
        start: Linearization,
        best_cost: float,
        begin: Callable[[Problem, Linearization], Linearization] | None = None,
        most: float = np.inf,
    ) -> tuple[Fit, Linearization]:
        """Fit a set of effects.

        Args:
            members: Effects of the set, by index.
            start: Start point in coordinates of all candidates, zero outside the set.
            best_cost: Least cost of all sets so far; a set that cannot reach it ends early [nats].
            begin: Finds a better start from there; None: the fit begins there.
            most: Weighted steps after which the fit ends where it is.
        """
        own = self.coordinates(members)
        at = Linearization(
            start.x[own], start.record, tuple(range(len(own))), start.slopes(own), start.slope_error
        )
        narrow = self.narrow(members)
        if begin is not None:
            label, first = f"begin of {self._label(members)}", partial(begin, narrow, at)
            at = self.remembered(label, first)
        until = narrow.model.simulations.steps + most
        if self.store is None:
            return gauss_newton(narrow, at, best_cost=best_cost, until=until)
        return gauss_newton_kept(self.store, narrow, at, best_cost, until)

    def with_weak_slopes(self, members: Members) -> Linearization:
        """A fitted set's linearization with right slopes along weak directions; the same object
        where they are right."""
        here = self.fitted[members]
        own = np.array(here.idx)
        at = replace(here, x=here.x[own], idx=tuple(range(len(own))))
        narrow = self.narrow(members)
        if slopes_are_simulated(narrow.model):
            better = mended(narrow, at)
            return here if better is at else replace(here, columns=better.columns)
        better = descended(narrow, at)
        return here if better is at else self.kept(members, better).fitted[members]

    def along_weak(self, members: Members) -> tuple[Linearization, Linearization | None]:
        """A fitted set's linearization with right slopes along weak directions, and where these
        lead; None: nowhere, or to where nothing can be simulated."""
        here, narrow = self.fitted[members], self.narrow(members)
        own = np.array(here.idx)
        at = mended(narrow, replace(here, x=here.x[own], idx=tuple(range(len(own)))))
        point, kept = stepped(narrow, at), self.kept(members, at).fitted[members]
        if point is None:
            return kept, None
        try:
            there = linearization_at(narrow, point)
        except DiffsimError:
            return kept, None
        return kept, self.kept(members, there).fitted[members]

    def near(self, members: Members, x: Array, step: float) -> Linearization | None:
        """A set's linearization beside some unknown cause, no further away in any coordinate.

        Args:
            members: Effects of the set, by index.
            x: Point in the coordinates of ``narrow``, (n,).
            step: Largest distance [prior sd].
        """
        made = self.at_unknowns.get(members, ())
        away = [float(np.abs(at.x - x).max(initial=0.0)) for at in made]
        return made[int(np.argmin(away))] if made and min(away) < step else None

    def noted(self, members: Members, at: Linearization) -> Simulations:
        """The simulations with a linearization of a set beside an unknown cause."""
        made = (*self.at_unknowns.get(members, ()), at)
        return replace(self, at_unknowns={**self.at_unknowns, members: made})

    def start(
        self, members: Members, center: Linearization, x: Array, *, anew: bool = False
    ) -> Linearization:
        """Warm start of a set, from fits of its subsets.

        An earlier fit of it, unless it starts anew; the center itself where the set only adds to
        it; else the optimum ``x`` of the linear evidence, with the center's slopes.
        """
        if members in self.fitted and not anew:
            return self.fitted[members]
        own = self.coordinates(members)
        outside = np.ones(len(center.x), dtype=bool)
        outside[own] = False
        if not center.x[outside].any():
            return center
        narrow = self.narrow(members)
        x = x.copy()
        x[own] = np.clip(x[own], *narrow.bounds)  # a linear optimum knows no bounds
        x[own] *= ~unfitted_shapes(narrow, center.x[own])  # nor how far slopes of a shape hold
        record = narrow.record(x[own])
        step = self.wide.scaled(x) - self.wide.scaled(center.x)
        predicted = center.slopes(range(len(x))) @ step
        off = linalg.norm(self.wide.whiten_all(record - center.record - predicted))
        moved = linalg.norm(self.wide.whiten_all(predicted))
        return replace(center, x=x, record=record, slope_error=float(off / max(moved, 1.0)))

    def screen(
        self, members: Members, last: Linearization | None
    ) -> tuple[Linearization, Simulations]:
        """All slopes at the fit of a set.

        Args:
            members: A fitted set.
            last: Slopes of all candidates at another set. They serve for effects that are neither
                significant with them nor like a member; None: all are simulated.
        """
        here, label = self.fitted[members], f"screened {self._label(members)}"
        screened = self.screened.get(members)
        if screened is None:
            screened = self.remembered(label, partial(self._screen_at, here, last))
        here = here.joined(screened)
        return here, replace(self, screened={**self.screened, members: screened})

    def _screen_at(self, here: Linearization, last: Linearization | None) -> Linearization:
        """A fit with the slopes of all candidates, as ``screen`` says."""
        if last is None:
            others = [i for i in range(len(here.x)) if i not in here.idx]
            return here.joined(linearization_at(self.wide, here.x, others, screen=True))
        again = [i for i in self._significant(here.joined(last)) if i not in here.idx]
        if again:
            here = here.joined(linearization_at(self.wide, here.x, again, screen=True))
        return here.joined(last)

    def center(self, members: Members, at: Linearization, num_families: int) -> Center:
        """A fitted set with the linear evidence of its neighbors; nothing is simulated."""
        return Center(members, at, self._evidence(at, [], num_families))

    def evidence_with_unknown(
        self, members: Members, unknown: Unknown, u: int, families: int
    ) -> LaplaceEvidence:
        """Evidence of a set's neighbors, an unknown cause beside; both were simulated there."""
        moved, _ = self.responses(unknown, u, members, self.screened[members])
        return self._evidence(self.screened[members], [moved], families)

    def scanned(
        self, center: Center, settings: SearchSettings, num_families: int
    ) -> tuple[Center, Simulations]:
        """A center with the scans of effects with kinks, and of pairs that mask each other.

        Args:
            center: A fitted set.
            settings: Largest number of effects in one set, of sizes and of weighted steps.
            num_families: Families of effects, for the evidence.
        """
        made, found = self, {}
        courses: dict[Effect, Course] = {}
        room = settings.max_effects - len(center.members)
        every = list(groups(self.wide.effects, center.members, room))
        new = [group for group in every if (center.members, group) not in self.scans]
        before = sum(scan.num_points for scan in self.scans.values())
        most = settings.scan_points - before, settings.scan_steps - self.scan_steps
        run = run_for_scans(self.wide, center.at, new, most)
        for group in every:
            key, members = (center.members, group), sorted(group)
            if key not in made.scans:
                points = 0  # of what is located by its course none are tried
                if self.wide.effects[members[0]].locate is None:
                    points = sum(s.num_points for s in made.scans.values())
                    effects = [self.wide.effects[i] for i in members]
                    points += num_points(effects, len(first_runs(self.wide.runs)))
                if points > settings.scan_points or made.scan_steps > settings.scan_steps:
                    made = replace(made, scans_late=made.scans_late | {(made.place, *key)})
                    continue
                result = self._scan(center, members, courses, run)
                spent = made.scan_steps + result.steps
                made = replace(made, scans={**made.scans, key: result}, scan_steps=spent)
                made = replace(made, scans_late=made.scans_late - {(made.place, *key)})
            if (at := made.scans[key].at) is not None:
                found[group] = made.center(center.members, at, num_families)
        return replace(center, scanned=found), made

    def _scan(
        self,
        center: Center,
        group: Sequence[int],
        courses: dict[Effect, Course],
        run: int | None,
    ) -> Scan:
        """Sizes of a group at a center, from this process or an earlier one.

        Args:
            center: A fitted set.
            group: Indices of effects that are tried together.
            courses: Courses at this center that are known, which grow.
            run: Index of the run that sizes are tried in; None: all.
        """
        label = f"scan of {self._label(frozenset(group))} at {self._label(center.members)}"
        if run is not None:  # a larger budget has all runs
            label += f" in {self.wide.runs[run].name}"
        own, effect = self.coordinates(center.members), self.wide.effects[group[0]]
        tally = self.wide.model.simulations
        before, make = tally.work, partial(scan, self.wide, own, center.at, group, run)
        if (locate := effect.locate) is not None:
            course = courses.get(locate.course)
            if course is None:  # apart from the scan: others share it
                course = self._course(own, center, locate)
                courses[locate.course] = course
            make = partial(scan_located, self.wide, own, center.at, effect, course)
        found = make() if self.store is None else _recall_scan(self.store, label, make)
        return replace(found, steps=tally.since(before).steps)

    def _course(self, own: Sequence[int], center: Center, locate: Locator) -> Course:
        """What any course in time would gain at a center."""

        def make() -> Arrays:
            course = course_at(self.wide, own, center.at, locate)
            return {"times": course.times, "gram": course.gram, "score": course.score}

        label = f"course {locate.course.name} at {self._label(center.members)}"
        return Course(**(make() if self.store is None else self.store.remembered(label, make)))

    def with_unknowns(
        self, center: Center, unknowns: Sequence[Unknown], num_families: int
    ) -> tuple[LaplaceEvidence, Simulations]:
        """Linear evidence at a set together with every unknown cause."""
        made, blocks = self, []
        for u, unknown in enumerate(unknowns):
            block, made = made.responses(unknown, u, center.members, center.at)
            blocks.append(spill(block))
        return made._evidence(center.at, blocks, num_families), made

    def responses(
        self, unknown: Unknown, u: int, members: Members, at: Linearization
    ) -> tuple[Array, Simulations]:
        """Whitened responses of an unknown cause, number ``u``, at a set; simulated once."""
        made = self
        if (members, u) not in self.unknown_slopes:
            slopes = self._slopes_of(unknown, members, at)
            made = replace(
                self, unknown_slopes={**self.unknown_slopes, (members, u): SpilledArray(slopes)}
            )
        return unknown.spread(self.wide, made.unknown_slopes[members, u].array()), made

    def _evidence(
        self, at: Linearization, blocks: Sequence[Array | SpilledArray], num_families: int
    ) -> LaplaceEvidence:
        wide = self.wide
        residual = wide.residual_of(at.record)
        jacobian = wide.whiten_all(at.slopes(range(len(at.x)))) * wide.stretch(at.x)
        return LaplaceEvidence(wide, at.x, residual, jacobian, blocks, num_families)

    def _label(self, members: Members) -> str:
        return " + ".join(self.wide.effects[i].name for i in sorted(members)) + self.place

    def remembered(self, label: str, make: Callable[[], Linearization]) -> Linearization:
        """A linearization by its name, from an earlier process or made now."""
        if self.store is None:
            return make()
        return unpacked(self.store.remembered(label, lambda: packed(make())))

    def _slopes_of(self, unknown: Unknown, members: Members, at: Linearization) -> Array:
        def make() -> Arrays:
            x = at.x[self.coordinates(members)]
            return {"slopes": unknown.slopes(self.narrow(members), x)}

        label = f"{unknown.label} at {self._label(members)}"
        kept = make() if self.store is None else self.store.remembered(label, make)
        return kept["slopes"]

    def _significant(self, at: Linearization) -> list[int]:
        """Coordinates of effects that stand out of the noise with borrowed slopes, or that are
        nearly collinear with a member."""
        wide = self.wide
        own = [i for i in range(len(at.x)) if i < wide.num_base or at.x[i] != 0.0]
        residual = wide.residual_of(at.record)
        slopes = wide.whiten_all(at.slopes(range(len(at.x))))
        j = slopes[:, own]
        at_best = Gaussian.of(j, residual)
        tilde = slopes - j @ at_best.solve(j.T @ slopes)
        information = np.clip(np.sum(slopes * tilde, axis=0), 1e-12, None)
        z = np.abs(slopes.T @ (residual - j @ at_best.mean))
        z /= np.sqrt(information)
        members = slopes[:, [i for i in own if i >= wide.num_base]]
        lengths = np.outer(linalg.norm(slopes, axis=0), linalg.norm(members, axis=0))
        alike = np.any(np.abs(slopes.T @ members) > ALIKE * lengths, axis=1, keepdims=True)[:, 0]
        chosen: list[int] = []
        for effect in wide.effects:
            c = wide.columns_of(effect)
            if z[c] @ z[c] > len(c) or alike[c].any():  # more than noise makes of it on average
                chosen += c
        return chosen


def _recall_scan(store: Store, label: str, make: Callable[[], Scan]) -> Scan:
    """A scan from an earlier process or made now."""

    def arrays() -> Arrays:
        found = make()
        best = {} if found.at is None else packed(found.at)
        return {"num_points": np.array(found.num_points), **best}

    kept = store.remembered(label, arrays)
    return Scan(unpacked(kept) if "x" in kept else None, int(kept["num_points"]))
