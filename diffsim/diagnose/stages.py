"""Stages of a diagnosis: null fit and noise, search, cross-check, gains on held-out runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.data.study import Run, Study
from diffsim.diagnose.crosscheck import swap_probability
from diffsim.diagnose.decide import Decision, decide
from diffsim.diagnose.descend import Descended, descend
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.evidence import Hypothesis
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.local import Local, local_at
from diffsim.diagnose.model import SimModel
from diffsim.diagnose.noise import NoiseFloor, noise_floor, without_spikes
from diffsim.diagnose.points import Points
from diffsim.diagnose.report import GateResult
from diffsim.diagnose.search import Search, SearchSettings
from diffsim.diagnose.store import Store
from diffsim.diagnose.unknown import Unknown
from diffsim.identify import Fit, Jacobian, Problem, Whitener, WhiteNoise

Array = NDArray[np.float64]
Progress = Callable[[str, float, str], None]
"""Stage, share of the whole that is done, message."""
SWAP_LIMIT = 0.02  # of noise alone: about three of 200 swapped draws may reach the statistic
NOISE_CHANGED = 0.03  # relative; a larger change of the floor asks for another round


def silent(stage: str, fraction: float, message: str) -> None:
    """No progress is shown."""


@dataclass(frozen=True, kw_only=True)
class DiagnosisSettings:
    """Effort and choices; the thresholds of the verdict are constants of ``decide``.

    Attributes:
        search: Effort of the search.
        jacobian: How to differentiate.
        workers: Threads over runs.
        accept_numerics: Go on although the numerics gate fails.
        noise_rounds: At most; the floor is estimated again after each.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    jacobian: Jacobian = field(default_factory=Jacobian)
    workers: int = 1
    accept_numerics: bool = False
    noise_rounds: int = 3


@dataclass(frozen=True, eq=False)
class Case:
    """What every step needs."""

    study: Study
    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...]
    settings: DiagnosisSettings
    progress: Progress = silent
    store: Store | None = None

    def problem(self, whitener: Whitener) -> Problem:
        """The plain model on the runs to be fitted."""
        s = self.settings
        return Problem(self.model, self.study.fit_runs, whitener, (), s.jacobian, workers=s.workers)

    def wide(self, null: Fit) -> Problem:
        return replace(null.problem, effects=self.effects)


def null_fit(case: Case) -> tuple[Case, NoiseFloor, Descended, int]:
    """Fit with rough noise, prepare the model there, spikes out, noise from what is left, again."""
    study = case.study
    raw = {r.name: r.measured for r in study.runs}
    channels = [
        c
        if c.sd is not None
        else replace(
            c, sd=noise_floor(study.fit_runs, (c,), {n: m[:, [i]] for n, m in raw.items()}).sd[0]
        )
        for i, c in enumerate(study.channels)
    ]
    problem = case.problem(WhiteNoise(channels))
    found = descend(problem, local_at(problem, np.zeros(problem.num_base)))
    prepared = case.model.prepared_at(torch.from_numpy(found.fit.x))
    if prepared is not case.model:
        prepared.simulations = case.model.simulations  # goes on counting
        case = replace(case, model=prepared)
        problem = case.problem(WhiteNoise(channels))
        found = descend(problem, local_at(problem, found.fit.x))
    cleaned = [without_spikes(r, left_of(found.fit, r)) for r in study.runs]
    num_spikes = sum(count for _, count in cleaned)
    study = replace(study, runs=tuple(run for run, _ in cleaned))
    case = replace(case, study=study)
    noise = noise_floor(study.fit_runs, study.channels, left_in(study.fit_runs, found.local))
    return case, noise, descend(case.problem(noise.whitener), found.local), num_spikes


def search_rounds(
    case: Case, noise: NoiseFloor, null: Descended, points: Points | None = None
) -> tuple[Search, NoiseFloor, Descended]:
    """Search; estimate the noise from what the best set leaves; again if it has changed, from what
    was simulated before."""
    runs = case.study.fit_runs

    def tell(count: int, names: str) -> None:
        # how many refits it will take is not known before: each takes a tenth of what is left
        case.progress("search", 0.85 - 0.6 * 0.9**count, names)

    for round_ in range(case.settings.noise_rounds):
        wide, effort = case.wide(null.fit), case.settings.search
        search = Search(wide, case.unknowns, null, effort, points, tell)
        search.run()
        points = search.points
        best = points.fitted[decision_of(search).best]
        after = noise_floor(runs, case.study.channels, left_in(runs, best))
        is_same = after.source == noise.source and bool(
            (np.abs(after.sd / noise.sd - 1.0) < NOISE_CHANGED).all()
        )
        if is_same or round_ == case.settings.noise_rounds - 1:
            break
        noise, null = after, descend(case.problem(after.whitener), null.local)
    return search, after, null


def decision_of(search: Search) -> Decision:
    entries = search.entries
    null = entries[Hypothesis()].fit
    assert null is not None
    # samples less effectively fitted parameters: tr (J'J) (J'J + 1)^-1
    fitted = null.problem.num_base - float(np.trace(null.covariance))
    return decide(
        {h: e.nats for h, e in entries.items()},
        {h: e.weighed.chi2 for h, e in entries.items() if h.unknown is None},
        null.num_samples - fitted,
    )


def confirmed(decision: Decision, search: Search, gates: list[GateResult], seed: int) -> Decision:
    """An unknown cause that repeats do not confirm is withdrawn; the check joins the gates."""
    if decision.unknown is None or decision.unknown.unknown is None:
        return decision
    best = search.entries[Hypothesis(decision.best)].fit
    assert best is not None
    cause = search.unknowns[decision.unknown.unknown]
    moved = search.responses(decision.best, decision.unknown.unknown)
    p = swap_probability(best.problem, best.residual, moved, seed=seed)
    if p is None:
        return decision
    gates.append(
        GateResult("swap", p <= SWAP_LIMIT, p, SWAP_LIMIT, f"{cause.name}: repeats as noise scale")
    )
    if p <= SWAP_LIMIT:
        return decision
    return replace(decision, verdict="named" if decision.best else "none", unknown=None)


def with_gains(
    case: Case, decision: Decision, search: Search, best: Fit, seed: int
) -> tuple[Decision, Gain | None, dict[int, Gain]]:
    """Gains on held-out runs; a name whose gain lies below zero is withdrawn."""
    runs = case.study.holdout_runs
    if not runs or not decision.best or decision.verdict not in ("named", "ambiguous"):
        return decision, None, {}
    null = search.entries[Hypothesis()].fit
    assert null is not None
    gains = {}
    known: dict[Fit, list[Array]] = {}
    for i in decision.best:
        without = search.refit(decision.best - {i})
        if without is not None and without.fit is not None:
            gains[i] = gain(runs, without.fit, best, seed=seed, known=known)
    kept = frozenset(i for i in decision.best if i not in gains or gains[i].status != "withdrawn")
    if kept != decision.best:
        verdict = decision.verdict if kept else "unknown"
        decision = replace(decision, best=kept, verdict=verdict)
        entry = search.refit(kept)
        if entry is None or entry.fit is None:
            return replace(decision, best=frozenset(), verdict="unknown"), None, gains
        best = entry.fit
    total = gain(runs, null, best, seed=seed, known=known) if kept else None
    return decision, total, gains


def left_of(fit: Fit, run: Run) -> Array:
    """(num_samples, num_channels) measured minus predicted [unit of the channel]."""
    with torch.no_grad():
        return run.measured - fit.problem.predict(run, torch.from_numpy(fit.x)).numpy()


def left_in(runs: Sequence[Run], local: Local) -> dict[str, Array]:
    """As ``left_of``, by run, from a record that is known."""
    edges = np.cumsum([run.measured.size for run in runs])[:-1]
    parts = np.split(local.record, edges)
    return {
        r.name: r.measured - p.reshape(r.measured.shape) for r, p in zip(runs, parts, strict=True)
    }
