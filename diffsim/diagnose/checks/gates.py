"""Checks before any physics is blamed: data, numerical settings, repeatability."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from diffsim.data.study import Study
from diffsim.diagnose.checks.noise import UNREPEATABLE
from diffsim.diagnose.checks.separate import cut_in_two, require_separate
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import FIT_RTOL, DiagnosisSettings
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.linearization import Linearization, record_at, whitened
from diffsim.identify.numerics import REFINEMENTS, NumericalEffect, Numerics, coarse

Array = NDArray[np.float64]
NUMERICS_LAMBDA = 2.0
# Of what a cause does, from which refining a setting once could be the cause: all further
# refinements of a first-order method change as much again, and near kinks none are in proportion.
NUMERICS_SHARE = 0.25
FIRST_ANSWER, COARSE, LATE = "first_answer", "coarse", "refit_budget"
ROUNDING = 1e-6  # noise sd: a change of the whole record below it is rounding
NUMERICS_GATES = ("time_step", "mesh", "tolerance")
REPEATS = "repeats:"
SCATTER_CHANCE = 1e-3  # of so large a scatter where the priors hold: repeats are few


@dataclass(frozen=True)
class GateResult:
    """One check before any physics is blamed.

    Attributes:
        name: Name of the check, such as "time_step".
        passed: Whether the check passed.
        value: Measured quantity, such as lambda.
        limit: Limit that the value is compared with.
        note: What was checked, in words.
        applies: Whether there was anything to check; what does not apply did not pass.
    """

    name: str
    passed: bool
    value: float
    limit: float
    note: str = ""
    applies: bool = True

    @property
    def status(self) -> str:
        """ "passed", "failed" or "does not apply"."""
        if not self.applies:
            return "does not apply"
        return "passed" if self.passed else "failed"


def data_gate(study: Study) -> tuple[GateResult, ...]:
    """Clocks, shapes, commands, repeats; runs of each use are recordings of their own.

    Raises:
        ValueError: nothing can be concluded from such files: the message names run and sample.
    """
    if not study.fit_runs:
        raise ValueError(f"study {study.name} has no run with use: fit; nothing can be diagnosed")
    for run in study.runs:
        want = (len(run.time_s), len(study.channels))
        if run.measured.shape != want:
            raise ValueError(
                f"run {run.name}: measured must have shape {want} (samples, channels), got "
                f"{run.measured.shape}"
            )
        steps = np.diff(run.time_s)
        if not (steps > 0.0).all():
            at = int(np.argmax(~(steps > 0.0))) + 1
            raise ValueError(f"run {run.name}: time_s must increase, but does not at sample {at}")
        if not np.isfinite(run.measured).any():
            raise ValueError(f"run {run.name}: nothing was measured; remove the run")
    require_separate(study)
    commands = len({r.group for r in study.fit_runs})
    repeats, tests = len(study.fit_runs) - commands, len(study.test_runs)
    seen_once = "runs that neither a fit nor the choice of causes has seen"
    if not tests:
        seen_once = "no run with use: test, so no gain is known"
    scatter = "runs of one command" if repeats else "no repeated run: repeatability is not judged"
    return (
        GateResult("commands", commands >= 2, commands, 2, "different commands among the fit runs"),
        GateResult("held_out", tests >= 1, tests, 1, seen_once, applies=tests > 0),
        _separate_gate(study),
        GateResult("repeats", repeats >= 1, repeats, 1, scatter, applies=repeats > 0),
    )


def _separate_gate(study: Study) -> GateResult:
    """Test and select runs are recordings of their own, not the rest of a fitted one."""
    pairs = cut_in_two(study)
    note = "select or test runs that go on where another run ends"
    if pairs:
        first, second = pairs[0]
        note = f"run {second.name} goes on where run {first.name} ends: it tests little"
    others = len(study.select_runs) + len(study.test_runs)
    return GateResult("separate_runs", not pairs, len(pairs), 0, note, applies=others > 0)


def numerics_changes(
    problem: Problem, at: Linearization, names: Iterable[str] = tuple(REFINEMENTS)
) -> dict[str, Array]:
    """(N,) change of the record by refining each setting; zero where the model has no such one.

    A setting coarser than the model's own may be no coarser in effect: steps end at samples at the
    latest. Where refining it changes nothing, it is refined beyond the model's own.

    Args:
        problem: Fitting problem whose runs are simulated again.
        at: Record with the settings in use, and where.
        names: Settings that are refined, one at a time.
    """
    out = {}
    for name in names:
        finer = (problem.numerics or Numerics()).refined(REFINEMENTS[name])
        out[name] = record_at(replace(problem, numerics=finer), at.x) - at.record
        while getattr(finer, name) >= 1.0 and _is_rounding(problem, out[name]):
            finer = finer.refined(REFINEMENTS[name])
            out[name] = record_at(replace(problem, numerics=finer), at.x) - at.record
    return out


def _is_rounding(problem: Problem, change: Array) -> bool:
    return length(whitened(problem, change)) < ROUNDING


def numerics_gate(fit: Fit, changes: Mapping[str, Array]) -> list[GateResult]:
    """Change of the record by refining each numerical setting, in noise units.

    lambda^2 = c' (1 + J J')^-1 c with c = W (S(refined) - S): what base parameters leave of it and
    what their priors ask for taking up the rest, so that lambda^2 / 2 are the nats to be had.
    Without the latter, parameters could be pulled far off their priors, and causes named for it.

    A cause of the set may have been named for the change itself, which then is not seen beside it.
    So a cause of which the change could be a good part is not refitted.
    """
    out = []
    for name, raw in changes.items():
        change = whitened(fit.problem, raw)
        size = length(left_over(change, fit.jacobian))
        for i in range(len(fit.problem.effects)):
            size = max(size, could_be(fit, i, change))
        out.append(
            GateResult(
                name,
                size < NUMERICS_LAMBDA,
                size,
                NUMERICS_LAMBDA,
                "noise and prior sd that refining moves record and refit",
            )
        )
    return out


def could_be(fit: Fit, i: int, change: Array) -> float:
    """Length of a whitened change of the record, all but a cause refitted; 0 where it is little of
    what the cause does.

    Args:
        fit: Fit of a set of effects.
        i: The effect's place in the fitted problem.
        change: (num_valid,) by refining a numerical setting once.
    """
    slopes = fit.jacobian[:, others_of(fit, i)]
    size = length(left_over(change, slopes))
    return size if size > NUMERICS_SHARE * length(left_over(moved_by(fit, i), slopes)) else 0.0


def moved_by(fit: Fit, i: int) -> Array:
    """(num_valid,) what an effect, by its place in the fitted problem, does to the record."""
    own = fit.problem.columns_of(fit.problem.effects[i])
    slopes = fit.jacobian[:, own] / fit.problem.stretch(fit.x)[own]
    return np.asarray(slopes @ fit.problem.scaled(fit.x)[own])


def others_of(fit: Fit, i: int) -> list[int]:
    """Coordinates of all but an effect."""
    own = fit.problem.columns_of(fit.problem.effects[i])
    return [c for c in range(len(fit.x)) if c not in own]


def left_over(change: Array, slopes: Array) -> Array:
    """A change of the record after a refit of coordinates with these slopes and unit priors, with
    the pull on these below it."""
    gram = slopes.T @ slopes + np.eye(slopes.shape[1])
    taken = np.linalg.solve(gram, slopes.T @ change)
    return np.concatenate([change - slopes @ taken, taken])


def length(change: Array) -> float:
    """Euclidean length."""
    return float(np.linalg.norm(change))


def numerical_effects(fit: Fit, changes: Mapping[str, Array]) -> tuple[NumericalEffect, ...]:
    """One candidate per setting that the model knows; rounding is none."""
    return tuple(
        coarse(name, REFINEMENTS[name])
        for name, change in changes.items()
        if not _is_rounding(fit.problem, change)
    )


def numerical_shift(fit: Fit, changes: Mapping[str, Array]) -> Array:
    """(n,) how far refined settings would move the coordinates of a fit, all settings in
    quadrature: (J'J + 1)^-1 J' W (S(refined) - S), no simulation."""
    j = fit.jacobian
    total = np.zeros(j.shape[1])
    for raw in changes.values():
        total += (posterior_covariance(j) @ (j.T @ whitened(fit.problem, raw))) ** 2
    return np.asarray(np.sqrt(total))


def effort_gate(settings: DiagnosisSettings) -> tuple[GateResult, ...]:
    """What a first answer leaves out; nothing of a full one.

    Args:
        settings: Effort of the diagnosis.
    """
    if not settings.is_first_answer:
        return ()
    until = settings.search.refit_seconds
    note = (
        f"sets of at most {settings.search.max_effects} causes were tried"
        + (f", no larger one after {until:g} CPU s of search" if math.isfinite(until) else "")
        + ", fits end within "
        f"{settings.fit_rtol:.0%} of their misfit or {settings.fit_nats:g} nats, and the noise was "
        "estimated once; what it names is likely, never certain"
    )
    return (GateResult(FIRST_ANSWER, False, settings.fit_rtol, FIT_RTOL, note, applies=False),)


def scan_gate(num_late: int, seconds: float) -> tuple[GateResult, ...]:
    """Whether the budget ended before all effects with kinks were tried over decades.

    It is in CPU seconds, so that a faster machine may see more: where it ended, this is said.

    Args:
        num_late: Groups of effects that were not tried.
        seconds: The budget [CPU s].
    """
    if num_late == 0:
        return ()
    note = f"groups of causes not tried over decades: {seconds:g} CPU s were over before"
    return (GateResult("scan_budget", False, float(num_late), 0.0, note),)


def refit_gate(num_late: int, seconds: float) -> tuple[GateResult, ...]:
    """Whether the budget ended before all rivals of the best set were refitted.

    Args:
        num_late: Sets that keep their linear evidence.
        seconds: The budget [CPU s].
    """
    if num_late == 0:
        return ()
    note = f"{num_late} rival sets were not refitted, as {seconds:g} CPU s were over"
    return (GateResult(LATE, False, float(num_late), 0.0, note, applies=False),)


def repeatability_gate(fit: Fit) -> list[GateResult]:
    """One check for each kind of nuisance that every run has for itself (``name@run``).

    A gain that jitters from run to run by more than was stated leaves no scatter in the channels:
    the gain of each run, a base parameter, takes it up, and the scatter is in these parameters.

    The deviation of its standardized values from their mean over a group of repeats is N(0, 1)
    after scaling, or less, as fits shrink it. Failed: the rms over all groups is above the limit of
    the channels' scatter, and so large that chance does not make it.

    Args:
        fit: Fit with the effects that the evidence asks for, so that a drift over runs that has a
            name is not scatter.
    """
    known = {run.name: run.group for run in fit.problem.runs}
    values: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for i, parameter in enumerate(fit.problem.model.base):
        stem, _, run = parameter.name.partition("@")
        if run in known:
            values[stem][known[run]].append(float(fit.x[i]))
    out = []
    for stem, groups in values.items():
        repeats = [np.array(g) for g in groups.values() if len(g) > 1]
        freedom = sum(len(g) - 1 for g in repeats)
        if not freedom:
            continue
        total = sum(float(((g - g.mean()) ** 2).sum()) for g in repeats)
        ratio = float(np.sqrt(total / freedom))
        passed = ratio <= UNREPEATABLE or float(chdtrc(freedom, total)) > SCATTER_CHANCE
        note = f"scatter of {stem} between repeats over what its prior allows"
        out.append(GateResult(f"{REPEATS}{stem}", passed, ratio, UNREPEATABLE, note))
    return out
