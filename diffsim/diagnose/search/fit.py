"""What is given to a diagnosis, and the fit of the plain model with its noise floor.

The misfit of a long run has many minima: a frequency that is a little off is out of phase at its
end, an unstable motion leaves the range of numbers. A quarter of each run has a wide valley. So
where whole runs are too hard, windows grow: the end of one fit starts the next.

Numerical settings are checked at the fit and refined, as long as the budget allows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.data.study import Run, Study
from diffsim.diagnose.checks.gates import GateResult
from diffsim.diagnose.checks.noise import (
    NoiseFloor,
    choose_commands,
    noise_floor,
    without_misread,
    without_spikes,
)
from diffsim.diagnose.checks.numerics import (
    SetNumerics,
    could_be_misfit,
    names_of_failed,
    note_numerics,
    numerics_changes,
    numerics_gate,
    refine_within,
)
from diffsim.diagnose.checks.one_run import MIN_SAMPLES
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.scan import groups, num_points
from diffsim.diagnose.search.store import Store
from diffsim.identify import Fit, Problem, Whitener, WhiteNoise
from diffsim.identify.correction import Correction
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.linearization import Linearization, linearization_at, residuals_by_run
from diffsim.identify.model import NOTHING, SimModel, Work, slopes_are_simulated
from diffsim.identify.numerics import Numerics
from diffsim.identify.unknown import Unknown

Array = NDArray[np.float64]
TABLE_SHARE = 0.25  # of a search, that slopes of all candidates may cost with refined settings
HARD_START_CHI2 = 25.0  # chi2 per sample, from which a fit needs an easier start

Ended = tuple[Fit, Linearization]


def first_fit(problem: Problem, windows: Sequence[float], until: float = math.inf) -> Ended:
    """Fit of the plain model from its prior; through growing windows where that fails.

    A model that cannot be simulated over its own windows (multiple shooting) is asked for shorter
    ones, ``SimModel.shortened``; the fit's problem holds the model that was used.

    Args:
        problem: The plain model on the runs to be fitted.
        windows: Shares of each run that are fitted first, ascending; (): only whole runs.
        until: Count of weighted steps of the model after which fits end where they are.

    Raises:
        DiffsimError: neither whole runs nor windows can be simulated and fitted.
    """
    model = problem.model
    while True:  # until windows are as short as they may be
        problem = replace(problem, model=model)
        try:
            return _fit_growing(problem, windows, until)
        except DiffsimError:
            shorter = model.shortened(problem.runs)
            if shorter is None:
                raise
            shorter.simulations = model.simulations  # goes on counting
            model = shorter


def cut(run: Run, share: float) -> Run:
    """The first part of a run.

    Args:
        run: Recorded run.
        share: Share of its samples that is kept.
    """
    count = len(run.time_s)
    keep = min(max(int(np.ceil(share * count)), MIN_SAMPLES), count)
    return run.part(slice(keep))


def _fit_growing(problem: Problem, windows: Sequence[float], until: float) -> Ended:
    start = np.zeros(problem.num_base)
    try:
        whole = gauss_newton(problem, linearization_at(problem, start), until=until)
    except DiffsimError as error:
        if not windows:
            raise
        found = grown(problem, start, windows, until)
        if found is None:
            raise error
        return found
    if (
        not windows
        or whole[0].ended == "budget"
        or (whole[0].converged and whole[0].chi2 < HARD_START_CHI2 * whole[0].num_samples)
    ):
        return whole
    through = grown(problem, start, windows, until)
    ends = [whole] if through is None else [whole, through]
    return min(ends, key=lambda end: end[0].chi2 + end[0].prior)


def grown(
    problem: Problem,
    x: Array,
    windows: Sequence[float],
    until: float = math.inf,
    most: float = math.inf,
) -> Ended | None:
    """Fits to growing parts of the runs; None where whole runs cannot be fitted from there.

    Args:
        problem: Problem on whole runs.
        x: Where the first fit begins, standardized coordinates, (n,).
        windows: Shares of each run, ascending.
        until: Count of weighted steps of the model after which fits end where they are.
        most: Chi-squared of a sample that a part may leave: more, and there is no easier start.
    """
    for share in windows:
        part = replace(problem, runs=tuple(cut(run, share) for run in problem.runs))
        if not any(np.isfinite(run.measured).any() for run in part.runs):
            continue  # a run-up, of which nothing was measured
        if problem.model.simulations.steps >= until:
            return None
        try:
            short, _ = gauss_newton(part, linearization_at(part, x), until=until)
        except (DiffsimError, ValueError):  # too hard still, or a model of whole runs only
            continue
        if short.chi2 > most * max(short.num_samples, 1):
            return None
        x = short.x
    try:
        return gauss_newton(problem, linearization_at(problem, x), until=until)
    except DiffsimError:
        return None


Progress = Callable[[str, float, str], None]
"""Stage, share of the whole that is done, message."""
MAX_RENEWALS = 3  # of an answer that shows that its settings, or its correction, do not hold


def silent(stage: str, fraction: float, message: str) -> None:
    """Show no progress."""


@dataclass(frozen=True, eq=False)
class Case:
    """Study, model, candidates and options of one diagnosis."""

    study: Study  # recorded runs with their channels and commands
    model: SimModel  # simulator with base parameters
    effects: tuple[Effect, ...]  # candidate causes that these data allow to be judged
    unknowns: tuple[Unknown, ...]  # generic causes, weighed beside the named ones
    settings: DiagnosisSettings  # effort of the diagnosis
    progress: Progress = silent  # receives stage, share done and message
    store: Store | None = None  # keeps simulations on disk; None: keep none
    # what the study lacks for the candidates that were left out, by name
    unmet: Mapping[str, str] = field(default_factory=dict)
    begun: Work = NOTHING  # what the model had simulated before
    # its weighted steps where the search begins: budgets of the search count from it
    searching: int = 0
    # refined numerical settings of all simulations; None: the model's own
    numerics: Numerics | None = None
    # what finer settings than ``numerics`` change, made at one point; None: nothing
    correction: Correction | None = None
    # what is left to refine beyond a correction that was made at a set; None: at none
    beyond: SetNumerics | None = None
    num_tests: int = 0  # test runs that are kept, and looked at after the answer is frozen

    def problem(self, whitener: Whitener | None = None) -> Problem:
        """The plain model on the runs to be fitted.

        Args:
            whitener: Of the noise; None: before anything is known of it, one unit where no ``sd``
                is stated.
        """
        s = self.settings
        if whitener is None:
            channels = [c if c.sd is not None else replace(c, sd=1.0) for c in self.study.channels]
            whitener = WhiteNoise(channels)
        return Problem(
            self.model,
            self.study.fit_runs,
            whitener,
            jacobian=s.jacobian,
            numerics=self.numerics,
            workers=s.workers,
            correction=self.correction,
        )


@dataclass(frozen=True, eq=False)
class Null:
    """The fitted plain model under a noise floor."""

    case: Case  # spikes removed from its study, its model prepared at the fit
    noise: NoiseFloor  # noise floor of the residuals
    fit: Fit  # fit of the base parameters, without effects
    at: Linearization  # linearization where the fit ended
    num_spikes: int  # number of samples that were removed as spikes
    num_misread: int = 0  # number of jumps of measured commands that were taken out

    @property
    def wide(self) -> Problem:
        """The fitted problem with all candidate effects."""
        return replace(self.fit.problem, effects=self.case.effects)

    def under(self, noise: NoiseFloor) -> Null:
        """Fitted again under another noise floor, from here."""
        fit, at = gauss_newton(self.case.problem(noise.whitener), self.at)
        return replace(self, noise=noise, fit=fit, at=at)


@dataclass(frozen=True, eq=False)
class RefinedNull:
    """The plain model under settings that are fine enough, or as fine as the budget allows."""

    null: Null  # fit of the plain model under these settings
    # change of the record by refining each setting further, by its name, (N,) each
    changes: dict[str, Array]
    # the numerics gate at the end; notes say what was refined and what it costs
    gates: tuple[GateResult, ...]


def coarsen_first_look(case: Case) -> tuple[Case, float]:
    """The case with the cells that a first answer begins with.

    Returns:
        The case, and the weighted steps of a simulation of all fitted runs with the cells that it
        was given; 0 where that is cheap.
    """
    settings, once = case.settings, case.problem().cost()
    if once < settings.dear_steps or settings.accept_numerics:
        return case, 0.0
    if settings.first_mesh == 1.0:
        return case, once
    larger = (case.numerics or Numerics()).refined(Numerics(mesh=settings.first_mesh))
    coarse = replace(case, numerics=larger)
    problem = coarse.problem()
    pays = problem.cost() < once and _can_be_simulated(problem)
    return (coarse if pays else case), once


def _can_be_simulated(problem: Problem) -> bool:
    """Whether the model at its prior can, by one run."""
    try:
        replace(problem, runs=problem.runs[:1]).record(np.zeros(problem.num_base))
    except (DiffsimError, ValueError):
        return False
    return True


def null_fit(case: Case) -> Null:
    """Fit the plain model, remove spikes, estimate the noise of the residuals, fit again.

    The first fit uses a rough noise floor, and measured commands without their jumps; the model
    prepares at its end what it prepares once.
    """
    study = case.study
    recorded = study.runs
    found = [without_misread(run, study.commands) for run in recorded]
    num_jumps = sum(count for _, count in found)
    case = replace(case, study=replace(study, runs=tuple(run for run, _ in found)))
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
    until = case.begun.steps + case.settings.plain_steps
    fit, at = first_fit(problem, case.settings.windows, until)
    case = replace(case, model=fit.problem.model)
    case, (fit, at) = _prepare(case, WhiteNoise(channels), (fit, at), until)
    rough = np.array([c.sd for c in channels], dtype=np.float64)
    chosen = [
        choose_commands(r, study.commands, partial(residual_of, fit), rough) for r in recorded
    ]
    num_misread = sum(count for _, count in chosen)
    kept = [run for run, _ in chosen]
    stated = np.array([c.sd or 0.0 for c in study.channels], dtype=np.float64)
    runs, num_spikes = without_spikes(kept, [residual_of(fit, run) for run in kept], stated)
    study = replace(study, runs=runs)
    case = replace(case, study=study)
    residuals = residuals_by_run(study.fit_runs, at.record)
    noise = noise_floor(study.fit_runs, study.channels, residuals)
    problem = case.problem(noise.whitener)
    # a model that fits initial states to the record predicts otherwise without spikes
    if num_spikes or num_misread != num_jumps:
        at = linearization_at(problem, fit.x)
    ended = gauss_newton(problem, at, until=until)
    return Null(case, noise, *ended, num_spikes, num_misread)


def _prepare(case: Case, whitener: Whitener, ended: Ended, until: float) -> tuple[Case, Ended]:
    """The case with its model prepared where the plain model's fit ended, fitted again there.

    Windows that are longer than those of the prior are kept where the fit converges in them.
    """
    fit, _ = ended
    q = torch.from_numpy(fit.x)
    prepared = case.model.prepared_at(q, case.study.fit_runs)
    if prepared is case.model:
        return case, ended
    prepared.prepared_q = q
    prepared.simulations = case.model.simulations  # goes on counting
    has_windows = bool(case.model.short_windows(case.study.fit_runs))
    new = replace(case, model=prepared)
    problem = new.problem(whitener)
    try:
        again = gauss_newton(problem, linearization_at(problem, fit.x), until=until)
    except DiffsimError:
        if not has_windows:
            raise
        return case, ended
    return (case, ended) if has_windows and not again[0].converged else (new, again)


def residual_of(fit: Fit, run: Run) -> Array:
    """Measured minus predicted in a run, (num_samples, num_channels) [unit of the channel]."""
    with torch.no_grad():
        return run.measured - fit.problem.predict(run, torch.from_numpy(fit.x)).numpy()


def check_numerics(null: Null) -> RefinedNull | None:
    """Check the settings at the null fit; refine and fit again where the gate fails. Where it would
    fail within the budget, too, and is no good part of the misfit, settings stay as they are.

    Args:
        null: The plain model, fitted with the model's own settings.

    Returns:
        None where slopes of all candidates with finer settings would cost too much of what a search
        may.
    """
    changes = numerics_changes(null.fit.problem, null.at)
    gates = tuple(numerics_gate(null.fit, changes))
    settings = null.case.settings
    if settings.accept_numerics or settings.refine_budget <= 1.0 or not names_of_failed(gates):
        gates = note_numerics(gates, null.fit.problem.numerics, 1.0, settings.refine_budget)
        return RefinedNull(null, changes, gates)
    once = null.fit.problem.cost()
    paid = 1.0
    for _ in range(MAX_RENEWALS):
        refined = ", ".join(names_of_failed(gates)).replace("_", " ")
        null.case.progress("null fit", 0.1, f"refining {refined}")
        numerics, finer, found, ratio = refine_within(
            null.fit, settings.refine_budget, changes, gates, once
        )
        finest = replace(null.wide, numerics=numerics)
        is_in_vain = bool(names_of_failed(found)) or _leaves_no_scans(finest, settings)
        if is_in_vain and not could_be_misfit(null.fit, gates):
            break
        if finest.cost_of_table() > TABLE_SHARE * settings.search.refit_steps:
            return None
        changes, gates = finer, found
        paid = max(paid, ratio)
        if numerics == (null.fit.problem.numerics or Numerics()):
            break  # the budget allows no finer ones
        null = refit_under(null, numerics)
        changes = numerics_changes(null.fit.problem, null.at)
        gates = tuple(numerics_gate(null.fit, changes))
        if not names_of_failed(gates):
            break
    return RefinedNull(
        null, changes, note_numerics(gates, null.fit.problem.numerics, paid, settings.refine_budget)
    )


def _leaves_no_scans(finer: Problem, settings: DiagnosisSettings) -> bool:
    """Whether sizes over decades would take, with finer settings and slopes that are simulations,
    what is for them: what is missing is found first, and settings are checked again with it."""
    if not slopes_are_simulated(finer.model):
        return False
    tried = groups(finer.effects, frozenset(), settings.search.max_effects)
    points = sum(num_points([finer.effects[i] for i in group]) for group in tried)
    points = min(points, settings.search.scan_points)
    return finer.cost_of_table(points) > TABLE_SHARE * settings.search.refit_steps


def refit_under(null: Null, numerics: Numerics) -> Null:
    """The plain model fitted again under other settings, with the noise of what it leaves."""
    case = replace(null.case, numerics=numerics)
    problem = case.problem(null.noise.whitener)
    until = case.model.simulations.steps + case.settings.plain_steps
    fit, at = gauss_newton(problem, linearization_at(problem, null.at.x), until=until)
    residuals = residuals_by_run(case.study.fit_runs, at.record)
    noise = noise_floor(case.study.fit_runs, case.study.channels, residuals)
    return replace(null, case=case, fit=fit, at=at).under(noise)
