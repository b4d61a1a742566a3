"""What is given to a diagnosis, and the fit of the plain model with its noise floor.

Its numerical settings are checked at the fit and refined, as long as the budget allows it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.data.study import Run, Study
from diffsim.diagnose.checks.gates import GateResult, numerics_changes, numerics_gate
from diffsim.diagnose.checks.noise import NoiseFloor, noise_floor, without_spikes
from diffsim.diagnose.checks.refine import (
    names_of_failed,
    note_numerics,
    refine_within,
    time_simulation,
)
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.store import Store
from diffsim.diagnose.search.windows import first_fit
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
MAX_REFITS = 3  # of the plain model: each may show that settings are still too coarse for it


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


@dataclass(frozen=True, eq=False)
class Refined:
    """The plain model under settings that are fine enough, or as fine as the budget allows.

    Attributes:
        null: Fit of the plain model under these settings.
        changes: Change of the record by refining each setting further, by its name, (N,) each.
        gates: The numerics gate at the end; notes say what was refined and what it costs.
    """

    null: Null
    changes: dict[str, Array]
    gates: tuple[GateResult, ...]


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


def check_numerics(null: Null) -> Refined:
    """Check the settings at the null fit; refine and fit again where the gate fails.

    Args:
        null: The plain model, fitted with the model's own settings.
    """
    changes = numerics_changes(null.fit.problem, null.at)
    gates = tuple(numerics_gate(null.fit, changes))
    settings = null.case.settings
    if settings.accept_numerics or settings.refine_budget <= 1.0 or not names_of_failed(gates):
        gates = note_numerics(gates, null.fit.problem.numerics, 1.0, settings.refine_budget)
        return Refined(null, changes, gates)
    once = time_simulation(null.fit.problem, null.at.x)
    paid = 1.0
    for _ in range(MAX_REFITS):
        null.case.progress("null fit", 0.1, f"refining {', '.join(names_of_failed(gates))}")
        numerics, changes, gates, ratio = refine_within(
            null.fit, settings.refine_budget, changes, gates, once
        )
        paid = max(paid, ratio)
        if numerics == (null.fit.problem.numerics or Numerics()):
            break  # the budget allows no finer ones
        null = refit_under(null, numerics)
        changes = numerics_changes(null.fit.problem, null.at)
        gates = tuple(numerics_gate(null.fit, changes))
        if not names_of_failed(gates):
            break
    return Refined(
        null, changes, note_numerics(gates, null.fit.problem.numerics, paid, settings.refine_budget)
    )


def refit_under(null: Null, numerics: Numerics) -> Null:
    """The plain model fitted again under other settings, with the noise of what it leaves."""
    case = replace(null.case, numerics=numerics)
    problem = case.problem(null.noise.whitener)
    fit, at = gauss_newton(problem, linearization_at(problem, null.at.x))
    residuals = residuals_by_run(case.study.fit_runs, at.record)
    noise = noise_floor(case.study.fit_runs, case.study.channels, residuals)
    return replace(null, case=case, fit=fit, at=at).under(noise)
