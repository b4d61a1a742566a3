"""Stages of a diagnosis: null fit and noise, search, cross-check, gains on held-out runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.data.study import Run, Study
from diffsim.diagnose.descend import Descended, descend
from diffsim.diagnose.judge import decision_of
from diffsim.diagnose.noise import NoiseFloor, noise_floor, without_spikes
from diffsim.diagnose.points import Points
from diffsim.diagnose.search import Search
from diffsim.diagnose.store import Store
from diffsim.identify import Fit, Problem, Whitener, WhiteNoise
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.local import Local, local_at
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
Progress = Callable[[str, float, str], None]
"""Stage, share of the whole that is done, message."""
NOISE_CHANGED = 0.03  # relative; a larger change of the floor asks for another round


def silent(stage: str, fraction: float, message: str) -> None:
    """No progress is shown."""


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
        prepared.prepared_q = torch.from_numpy(found.fit.x)
        prepared.simulations = case.model.simulations  # goes on counting
        case = replace(case, model=prepared)
        problem = case.problem(WhiteNoise(channels))
        found = descend(problem, local_at(problem, found.fit.x))
    cleaned = [without_spikes(r, left_of(found.fit, r)) for r in study.runs]
    num_spikes = sum(count for _, count in cleaned)
    study = replace(study, runs=tuple(run for run, _ in cleaned))
    case = replace(case, study=study)
    noise = noise_floor(study.fit_runs, study.channels, left_in(study.fit_runs, found.local))
    problem, local = case.problem(noise.whitener), found.local
    if num_spikes:  # a model that fits initial states to the record predicts otherwise without them
        local = local_at(problem, found.fit.x)
    return case, noise, descend(problem, local), num_spikes


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
