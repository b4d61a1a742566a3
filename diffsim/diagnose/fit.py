"""What is given to a diagnosis, and the fit of the plain model with its noise floor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.data.study import Run, Study
from diffsim.diagnose.gauss_newton import gauss_newton
from diffsim.diagnose.noise import NoiseFloor, noise_floor, without_spikes
from diffsim.diagnose.store import Store
from diffsim.diagnose.windows import first_fit
from diffsim.identify import Fit, Problem, Whitener, WhiteNoise
from diffsim.identify.correction import Correction
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.linearization import (
    Linearization,
    linearization_at,
    residuals_by_run,
)
from diffsim.identify.model import SimModel
from diffsim.identify.numerics import Numerics
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
Progress = Callable[[str, float, str], None]
"""Stage, share of the whole that is done, message."""


def silent(stage: str, fraction: float, message: str) -> None:
    """Show no progress."""


@dataclass(frozen=True, eq=False)
class Case:
    """Study, model, candidates and options of one diagnosis.

    Attributes:
        study: Recorded runs with their channels and commands.
        model: Simulator with base parameters.
        effects: Candidate causes that these data allow to be judged.
        unknowns: Generic causes, weighed beside the named ones.
        settings: Effort of the diagnosis.
        progress: Receives stage, share done and message.
        store: Keeps simulations on disk; None: keep none.
        unmet: What the study lacks for the candidates that were left out, by name.
        num_simulated: Simulations that the model had made before.
        numerics: Refined numerical settings of all simulations; None: the model's own.
        correction: What finer settings than ``numerics`` change, told at one point; None: nothing.
        num_tests: Test runs that are kept, and looked at after the answer is frozen.
    """

    study: Study
    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...]
    settings: DiagnosisSettings
    progress: Progress = silent
    store: Store | None = None
    unmet: Mapping[str, str] = field(default_factory=dict)
    num_simulated: int = 0
    numerics: Numerics | None = None
    correction: Correction | None = None
    num_tests: int = 0

    def problem(self, whitener: Whitener) -> Problem:
        """The plain model on the runs to be fitted."""
        s = self.settings
        return Problem(
            self.model,
            self.study.fit_runs,
            whitener,
            jacobian=s.jacobian,
            numerics=self.numerics,
            workers=s.workers,
            fit_rtol=s.fit_rtol,
            fit_nats=s.fit_nats,
            bend_after=s.bend_after,
            correction=self.correction,
        )


@dataclass(frozen=True, eq=False)
class Null:
    """The fitted plain model under a noise floor.

    Attributes:
        case: Spikes removed from its study, its model prepared at the fit.
        noise: Noise floor of the residuals.
        fit: Fit of the base parameters, without effects.
        at: Linearization where the fit ended.
        num_spikes: Number of samples that were removed as spikes.
    """

    case: Case
    noise: NoiseFloor
    fit: Fit
    at: Linearization
    num_spikes: int

    @property
    def wide(self) -> Problem:
        """The fitted problem with all candidate effects."""
        return replace(self.fit.problem, effects=self.case.effects)

    def under(self, noise: NoiseFloor) -> Null:
        """Fitted again under another noise floor, from here."""
        fit, at = gauss_newton(self.case.problem(noise.whitener), self.at)
        return replace(self, noise=noise, fit=fit, at=at)


def null_fit(case: Case) -> Null:
    """Fit the plain model, remove spikes, estimate the noise of the residuals, fit again.

    The first fit uses a rough noise floor; the model prepares at its end what it prepares once.
    """
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
    fit, at = first_fit(problem, case.settings.windows)
    case = replace(case, model=fit.problem.model)
    prepared = case.model.prepared_at(torch.from_numpy(fit.x))
    if prepared is not case.model:
        prepared.prepared_q = torch.from_numpy(fit.x)
        prepared.simulations = case.model.simulations  # goes on counting
        case = replace(case, model=prepared)
        problem = case.problem(WhiteNoise(channels))
        fit, at = gauss_newton(problem, linearization_at(problem, fit.x))
    cleaned = [without_spikes(r, residual_of(fit, r)) for r in study.runs]
    num_spikes = sum(count for _, count in cleaned)
    study = replace(study, runs=tuple(run for run, _ in cleaned))
    case = replace(case, study=study)
    residuals = residuals_by_run(study.fit_runs, at.record)
    noise = noise_floor(study.fit_runs, study.channels, residuals)
    problem = case.problem(noise.whitener)
    if num_spikes:  # a model that fits initial states to the record predicts otherwise without them
        at = linearization_at(problem, fit.x)
    return Null(case, noise, *gauss_newton(problem, at), num_spikes)


def residual_of(fit: Fit, run: Run) -> Array:
    """Measured minus predicted in a run, (num_samples, num_channels) [unit of the channel]."""
    with torch.no_grad():
        return run.measured - fit.problem.predict(run, torch.from_numpy(fit.x)).numpy()
