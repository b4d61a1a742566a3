"""All groups of a study judged, each by what the other groups taught."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import require_choice
from diffsim.core.threads import one_thread
from diffsim.data.fault_keys import FaultKeys
from diffsim.data.study import Study
from diffsim.diagnose.faults.candidates import (
    UNLISTED_FACTOR,
    Candidate,
    candidates,
)
from diffsim.diagnose.faults.evidence import Evidence, evidence, informations, mixed
from diffsim.diagnose.faults.given import take_apart
from diffsim.diagnose.faults.groups import Group
from diffsim.diagnose.faults.learn import GroupPosterior, learn
from diffsim.diagnose.faults.local import Local, local_at, problem_of
from diffsim.diagnose.faults.marginal import Information, Priors
from diffsim.diagnose.faults.states import possible_states
from diffsim.diagnose.faults.verdict import (
    CandidateEvidence,
    FaultReport,
    FaultVerdict,
    Spread,
    verdict_of,
)
from diffsim.diagnose.judge.records import Interval
from diffsim.diagnose.search.evidence import VISIBLE
from diffsim.identify.effect import PRIOR_WIDTH, Effect
from diffsim.identify.problem import PredictionError, Problem
from diffsim.identify.setup import DiagnosisSetup
from diffsim.identify.whitening import WhiteNoise

Array = NDArray[np.float64]
REFINED_NATS = 8.0  # below the best set: sets that are linearized again at their own sizes
NUM_REFINEMENTS = 2
ENDS = (0.05, 0.95)  # shares of draws below the two ends of an interval
LONGEST_STEP = 1.5  # of a scaled size from one linearization to the next

Progress = Callable[[int, int], None]


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
        verdicts.append(judged_group(group, others, keys, sets, seed))
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
) -> FaultVerdict:
    """What may be said of one group.

    Args:
        group: The group; it is not among those that taught.
        learned: What other groups say.
        keys: ``faults`` of the study.
        sets: Sets of causes that may act at once.
        seed: Of the draws of sizes.
    """
    rng = np.random.default_rng(seed)
    effects = {e.name: e for e in learned.problem.effects}
    point = np.zeros(len(learned.problem.names))
    point[: len(learned.point)] = learned.point
    states = possible_states(group, learned, keys)
    problems = [problem_of(learned.problem, s.group) for s in states]
    locals_ = [local_at(p, learned.layout, point, p.effects) for p in problems]
    seen = [known.causes for known in learned.locals.values()]
    tried = candidates(keys, sets, seen)
    names = [e.name for e in learned.problem.effects]
    found: list[list[Evidence]] = [[] for _ in tried]
    sizes: list[list[Information]] = []  # by state
    priors: list[Priors] = []
    for state, local in zip(states, locals_, strict=True):
        known = {
            factor: learned.priors(local, new_state=state.is_new, daily_factor=factor)
            for factor in (1.0, UNLISTED_FACTOR)
        }
        by_factor = {factor: informations(local, given) for factor, given in known.items()}
        sizes.append(by_factor[1.0])
        priors.append(known[1.0])
        for candidate, row in zip(tried, found, strict=True):
            at = [names.index(c) for c in candidate.causes]
            given = by_factor[UNLISTED_FACTOR if candidate.is_unlisted else 1.0]
            own = [effects[c] for c in candidate.causes]
            row.append(evidence([f.only(at) for f in given], own, rng))
    best = max(
        e.log_evidence + s.log_odds for row in found for e, s in zip(row, states, strict=True)
    )
    for candidate, row in zip(tried, found, strict=True):
        for k, (state, problem) in enumerate(zip(states, problems, strict=True)):
            if candidate.causes and row[k].log_evidence + state.log_odds > best - REFINED_NATS:
                row[k] = _refine_evidence(
                    problem, learned, point, candidate, row[k], rng, priors[k]
                )
    odds = [s.log_odds for s in states]
    evidences = [
        CandidateEvidence(c, mixed(row, odds)) for c, row in zip(tried, found, strict=True)
    ]
    sound = [e.log_evidence + o for e, o in zip(found[0], odds, strict=True)]
    likely = int(np.argmax(sound))
    visible = _smallest_visible(sizes[likely], learned.problem.effects)
    return verdict_of(group, evidences, effects, visible)


def _refine_evidence(
    problem: Problem,
    learned: GroupPosterior,
    point: Array,
    candidate: Candidate,
    found: Evidence,
    rng: np.random.Generator,
    priors: Priors,
) -> Evidence:
    """Evidence of a set linearized at its own most probable sizes."""
    own = [e for c in candidate.causes for e in problem.effects if e.name == c]
    columns = [problem.columns_of(e)[0] for e in own]
    at = point.copy()
    for _ in range(NUM_REFINEMENTS):
        step = np.clip(found.scaled - at[columns], -LONGEST_STEP, LONGEST_STEP)
        at[columns] += step
        local = _local_near(problem, learned, at, columns, step, own)
        found = evidence(informations(local, priors), own, rng)
    return found


def _local_near(
    problem: Problem,
    learned: GroupPosterior,
    at: Array,
    columns: Sequence[int],
    step: Array,
    own: Sequence[Effect],
) -> Local:
    """The group linearized at a point; half the step where it cannot be simulated."""
    for _ in range(4):
        try:
            return local_at(problem, learned.layout, at, own)
        except PredictionError:
            step = 0.5 * step
            at[list(columns)] -= step
    return local_at(problem, learned.layout, at, own)


def _smallest_visible(found: Sequence[Information], effects: Sequence[Effect]) -> dict[str, float]:
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
