"""All groups of a study judged, each by what the other groups taught."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import require_choice
from diffsim.core.checked import checked
from diffsim.core.threads import one_thread
from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Channel, Study
from diffsim.diagnose.faults.candidates import (
    UNLISTED_FACTOR,
    Candidate,
    candidates,
)
from diffsim.diagnose.faults.evidence import Evidence, evidence, informations, mixed
from diffsim.diagnose.faults.given import take_apart
from diffsim.diagnose.faults.goals import Fit, Rows, rows_at
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.learn import KNOWN_PRECISION, GroupPosterior, learn
from diffsim.diagnose.faults.local import problem_of
from diffsim.diagnose.faults.marginal import Priors
from diffsim.diagnose.faults.states import State, possible_states
from diffsim.diagnose.faults.verdict import (
    ENDS,
    CandidateEvidence,
    FaultReport,
    FaultVerdict,
    Spread,
    verdict_of,
)
from diffsim.diagnose.judge.records import Interval
from diffsim.diagnose.search.evidence import VISIBLE
from diffsim.identify.effect import PRIOR_WIDTH, Effect
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.problem import PredictionError, Problem
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.whitening import WhiteNoise

REFINED_NATS = 8.0  # below the best set: sets that are linearized again at their own sizes

Progress = Callable[[int, int], None]


@checked
@one_thread
def judge_faults(
    study: Study,
    setup: DiagnosisSetup,
    *,
    seed: int = 0,
    groups: Sequence[str] = (),
    progress: Progress | None = None,
) -> FaultReport:
    """Judge groups of runs for faults, against the scatter between groups.

    Args:
        study: Study with ``faults``; its channels state their noise.
        setup: Model and candidate causes of the study.
        seed: Of the draws of scatter and sizes.
        groups: Groups to judge; none: those that do not teach, or all where all do.
        progress: Called with the number of judged groups and of all.

    Raises:
        ValueError: the study has no ``faults``, or they name what is not there.
    """
    given = take_apart(study, setup)
    keys, all_groups, sets = given.keys, given.groups, given.sets
    for label in groups:
        require_choice("--groups", label, [g.label for g in all_groups])
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), setup.effects)
    learned = learn(problem, given.layout, all_groups, seed=seed, state=keys.state)
    judged = [g for g in all_groups if g.label in groups] if groups else _unknown(all_groups)
    verdicts = []
    for done, group in enumerate(judged):
        if progress is not None:
            progress(done, len(judged))
        others = learned.without(group.label) if group.teaches else learned
        verdicts.append(judged_group(group, others, keys, sets, seed, study.channels))
    return FaultReport(study.name, _spreads(learned), tuple(verdicts))


def _unknown(groups: Sequence[Group]) -> list[Group]:
    """Groups that do not teach; all, if there are none."""
    return [g for g in groups if not g.teaches] or list(groups)


def judged_group(
    group: Group,
    learned: GroupPosterior,
    keys: FaultKeys,
    sets: Sequence[tuple[str, ...]],
    seed: int,
    channels: Sequence[Channel],
) -> FaultVerdict:
    """What may be said of one group.

    Args:
        group: The group; it is not among those that taught.
        keys: ``faults`` of the study.
        sets: Sets of causes that may act at once.
        seed: Of the draws of sizes.
    """
    rng = np.random.default_rng(seed)
    effects = {e.name: e for e in learned.problem.effects}
    states = possible_states(group, learned, keys)
    tried = candidates(keys, sets, [known.causes for known in learned.locals.values()])
    views = [_View.of(learned, s, keys) for s in states]
    odds = [s.log_odds for s in states]
    found = [[view.weigh(c, effects, rng) for view in views] for c in tried]
    best = max(e.log_evidence + o for row in found for e, o in zip(row, odds, strict=True))
    for candidate, row in zip(tried, found, strict=True):
        for k, view in enumerate(views):
            if candidate.causes and row[k].log_evidence + odds[k] > best - REFINED_NATS:
                row[k] = view.refine(candidate, effects, row[k], rng)
    evidences = [
        CandidateEvidence(c, mixed(row, odds)) for c, row in zip(tried, found, strict=True)
    ]
    sound = [e.log_evidence + o for e, o in zip(found[0], odds, strict=True)]
    likely = views[int(np.argmax(sound))]
    visible = _smallest_visible(likely.all_sizes(), learned.problem.effects)
    verdict = verdict_of(group, evidences, effects, visible)
    names = [channel.name for channel in channels]
    return replace(verdict, set_aside=likely.set_aside(verdict.causes, effects, names))


@dataclass(frozen=True, eq=False)
class _View:
    """A group as it shows in one state."""

    learned: GroupPosterior
    problem: Problem  # the group's runs alone
    point: Array  # scaled coordinates of that problem without a cause, (n,)
    rows: Rows  # the group, linearized there
    priors: Mapping[float, Priors]  # what is known of its nuisances, by factor on the spreads
    known: Mapping[str, float]  # scaled sizes of causes that are known

    @classmethod
    def of(cls, learned: GroupPosterior, state: State, keys: FaultKeys) -> _View:
        """The group of a state."""
        problem = problem_of(learned.problem, state.group)
        point = np.zeros(len(problem.names))
        point[: len(learned.point)] = learned.point
        rows = rows_at(problem, learned.layout, point, problem.effects)
        priors = {
            factor: learned.priors(rows, new_state=state.is_new, daily_factor=factor)
            for factor in (1.0, UNLISTED_FACTOR)
        }
        known = learned.known_sizes(keys.sizes)
        return cls(learned, problem, point, rows, priors, known)

    def weigh(
        self, candidate: Candidate, effects: Mapping[str, Effect], rng: np.random.Generator
    ) -> Evidence:
        """Evidence of an explanation, linearized without a cause; at sizes that are known."""
        own = [effects[c] for c in candidate.causes]
        factor = UNLISTED_FACTOR if candidate.is_unlisted else 1.0
        rows = self.rows.only(candidate.causes)
        if any(e.name in self.known for e in own):
            rows = rows_at(self.problem, self.learned.layout, self._at(own), own)
        return self._evidence(rows, own, rng, factor)

    def refine(
        self,
        candidate: Candidate,
        effects: Mapping[str, Effect],
        found: Evidence,
        rng: np.random.Generator,
    ) -> Evidence:
        """Evidence of a set linearized at its own most probable sizes."""
        own = [effects[c] for c in candidate.causes]
        columns = [self.problem.columns_of(e)[0] for e in own]
        at = self._at(own)
        for _ in range(2):
            # of a scaled size from one linearization to the next
            step = np.clip(found.scaled - at[columns], -1.5, 1.5)
            at[columns] += step
            found = self._evidence(self._rows_near(at, columns, step, own), own, rng)
        return found

    def all_sizes(self) -> list[Gaussian]:
        """What a sound group says of the sizes of all causes."""
        local = self._fit(self.rows, self.problem.effects, 1.0).local
        return informations(local, self.priors[1.0])

    def set_aside(
        self, causes: Sequence[str], effects: Mapping[str, Effect], names: Sequence[str]
    ) -> tuple[str, ...]:
        """Rows and goals that are not trusted where these causes act."""
        own = [effects[c] for c in causes]
        rows = rows_at(self.problem, self.learned.layout, self._at(own), own)
        return rows.set_aside(self._fit(rows, own, 1.0).choice, names)

    def _at(self, own: Sequence[Effect]) -> Array:
        """The point, with the sizes that are known."""
        at = self.point.copy()
        for effect in own:
            at[self.problem.columns_of(effect)[0]] = self.known.get(effect.name, 0.0)
        return at

    def _fit(self, rows: Rows, own: Sequence[Effect], factor: float) -> Fit:
        num = rows.slopes.shape[1] - len(own)
        precision = np.zeros((num + len(own), num + len(own)))
        slope = np.zeros(len(precision))
        precision[:num, :num] = self.priors[factor].precision.mean(axis=0)
        slope[:num] = self.priors[factor].slope.mean(axis=0)
        for k, effect in enumerate(own):
            size = self.known.get(effect.name, 0.0)
            # precision of a size that is known
            held = 1e12 if effect.name in self.known else KNOWN_PRECISION
            precision[num + k, num + k], slope[num + k] = held, held * size
        return rows.robust(self.learned.tails.widened(factor), precision, slope)

    def _evidence(
        self,
        rows: Rows,
        own: Sequence[Effect],
        rng: np.random.Generator,
        factor: float = 1.0,
    ) -> Evidence:
        local = self._fit(rows, own, factor).local
        return evidence(informations(local, self.priors[factor]), own, rng, self.known)

    def _rows_near(
        self, at: Array, columns: Sequence[int], step: Array, own: Sequence[Effect]
    ) -> Rows:
        """The group linearized at a point; half the step where it cannot be simulated."""
        layout = self.learned.layout
        for _ in range(4):
            try:
                return rows_at(self.problem, layout, at, own)
            except PredictionError:
                step = 0.5 * step
                at[list(columns)] -= step
        return rows_at(self.problem, layout, at, own)


def _smallest_visible(found: Sequence[Gaussian], effects: Sequence[Effect]) -> dict[str, float]:
    """Size of each cause alone whose misfit would be ``VISIBLE`` sd of noise and scatter."""
    curvature = np.mean([f.curvature for f in found], axis=0)
    sd = 1.0 / np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    return {
        e.name: float(VISIBLE * s * PRIOR_WIDTH * e.typical)
        for e, s in zip(effects, sd, strict=True)
    }


def _spreads(learned: GroupPosterior) -> tuple[Spread, ...]:
    """Learned spreads with their intervals, those of the draws."""
    factors = np.exp(np.vstack([learned.log_spread, np.quantile(learned.draws, ENDS, axis=0)]))
    return tuple(
        Spread(name, stated, Interval(*(float(stated * f) for f in factor)))
        for name, stated, factor in zip(
            learned.layout.families, learned.layout.stated, factors.T, strict=True
        )
    )
