"""First answers about expensive simulations: coarse ones, corrected by what finer ones say.

A simulation of all fitted runs that costs more than ``DiagnosisSettings.dear_steps`` begins
with larger cells and longer steps. At the plain fit settings are refined, one at a time, until what
is left to refine is below the limit of the numerics gate. What they change becomes a ``Correction``
of the coarse records; nothing else is simulated so finely. At the answer the same is simulated
again: where the correction would be another one there, the search goes on from there.

Of any answer, settings that suit the plain model but not the best set are corrected there so.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diffsim.core.figures import figure
from diffsim.data.study import Run
from diffsim.diagnose.checks.gates import COARSE, CORRECTED, GateResult
from diffsim.diagnose.checks.numerics import NUMERICS_LAMBDA, length, numerics_gate
from diffsim.diagnose.search.fit import Null
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit, Problem
from diffsim.identify.correction import Correction, Finer
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.linearization import Linearization
from diffsim.identify.numerics import REFINEMENTS, Numerics

Array = NDArray[np.float64]
MAX_LEVELS = 6  # refinements of one setting: a gantry's steps of 2 ms moved 101 noise sd
FINEST_SHARE = 1.0 / 32.0  # of a search, that its finest simulation may cost: there are a few
SECOND_ORDER, SLOWEST = 0.25, 0.7  # ratio of a change to the one before, as far as it is taken
NEGLIGIBLE = 0.1  # noise and prior sd that a setting moves: no correction is needed
CHEAP = 2.0  # times the first simulation: to refine more than is needed


@dataclass(frozen=True, eq=False)
class CorrectionAt:
    """A correction, with what is left beyond it."""

    correction: Correction  # what the refined settings change
    # what further refining would change, by setting, (N,) each: extrapolated
    changes: dict[str, Array]
    gates: tuple[GateResult, ...]  # one per setting


def corrected(null: Null, once: float) -> tuple[Null, CorrectionAt]:
    """The plain model with the correction that its fit asks for, and fitted again.

    Args:
        null: The plain model, fitted with coarse settings.
        once: Weighted steps of a simulation of all runs with the cells that were given.
    """
    found = find_correction(null.fit, null.at, null.case.settings, once)
    case = replace(null.case, correction=found.correction)
    x = null.at.x - found.correction.shift.numpy()
    problem = case.problem(null.noise.whitener)
    x = np.clip(x, *problem.bounds)
    until = case.model.simulations.steps + case.settings.plain_steps
    fit, at = gauss_newton(problem, replace(null.at, x=x, record=problem.record(x)), until=until)
    return replace(null, case=case, fit=fit, at=at), found


def find_correction(
    fit: Fit, at: Linearization, settings: DiagnosisSettings, once: float
) -> CorrectionAt:
    """The correction that a fit asks for.

    Args:
        fit: Fit with coarse settings, not corrected.
        at: Linearization at its end, base parameters first.
        settings: Budgets of refinement and of the search.
        once: Weighted steps of a simulation of all runs with the cells that were given.
    """
    dearest = settings.refine_budget * once
    if settings.refine_budget > 1.0 and math.isfinite(settings.search.refit_steps):
        dearest = max(dearest, FINEST_SHARE * settings.search.refit_steps)
    refined = [_refine_setting(fit, at, name, dearest, CHEAP * once) for name in REFINEMENTS]
    coarse = fit.problem.numerics or Numerics()
    finer = tuple(r.finer for r in refined if r.finer.numerics != coarse)
    total = np.sum([r.added for r in refined], axis=0)
    correction = Correction(fit.problem, at.x, finer)
    gates = tuple(_gate(r, coarse) for r in refined)
    changes = {
        r.name: r.change if r.unsure is not None else _next(r.sizes) * r.change for r in refined
    }
    return CorrectionAt(correction.known(fit.problem.runs, total), changes, gates)


@dataclass(frozen=True, eq=False)
class _RefinedSetting:
    """One setting, refined step by step at a fit."""

    name: str
    # the finest that was simulated, and the shift that makes coarse records most like it
    finer: Finer
    added: Array  # what is left of the change then, (N,) [unit of the channel]
    # the last step's change of the record, as if records were linear, (N,); of extrapolated records
    # what may be off
    change: Array
    sizes: tuple[float, ...] = ()  # of every step's change, as the numerics gate measures it
    # by how much extrapolated records may be off [noise and prior sd]; None: none are
    unsure: float | None = None

    @property
    def left(self) -> float:
        """What one more refinement would change, extrapolated [noise and prior sd]; or how far
        extrapolated records may be off."""
        return _next(self.sizes) * self.sizes[-1] if self.unsure is None else self.unsure


def _refine_setting(
    fit: Fit, at: Linearization, name: str, dearest: float, cheap: float
) -> _RefinedSetting:
    """Refine a setting until what is left is well below the limit, or costs too much.

    Args:
        fit, at: As of ``find_correction``.
        dearest, cheap: Weighted steps of the finest simulation, at most: as far as it is needed,
            and beyond.
    """
    problem, coarse = fit.problem, fit.problem.numerics or Numerics()
    by_base = at.slopes(range(problem.num_base))
    nothing = np.zeros_like(at.record)
    here = _RefinedSetting(name, Finer(coarse, np.zeros(problem.num_base)), nothing, nothing)
    records, before = [at.record], coarse
    for _ in range(MAX_LEVELS):
        there = here.finer.numerics.refined(REFINEMENTS[name])
        record = replace(problem, numerics=there).record(at.x)
        raw = numerics_gate(fit, {name: record - at.record})[0].value
        if not here.sizes and raw < NEGLIGIBLE:  # or the model has no such setting
            return replace(here, sizes=(raw,), change=record - at.record)
        records.append(record)
        shift, added = _fit_shift(fit, record, here.finer.shift)
        change = by_base @ (shift - here.finer.shift) + added - here.added
        size = numerics_gate(fit, {name: change})[0].value
        before, sizes = here.finer.numerics, (*here.sizes, size)
        here = _RefinedSetting(name, Finer(there, shift), added, change, sizes)
        enough = here.left < NUMERICS_LAMBDA
        if min(size, here.left) < 0.5 * NUMERICS_LAMBDA:
            break
        next_cost = replace(problem, numerics=there.refined(REFINEMENTS[name])).cost()
        if next_cost > (cheap if enough else dearest):
            break
    is_enough = here.left < NUMERICS_LAMBDA or len(records) < 3
    return here if is_enough else _to_limit(fit, here, before, records[-3:])


def _to_limit(
    fit: Fit, here: _RefinedSetting, before: Numerics, records: Sequence[Array]
) -> _RefinedSetting:
    """A setting whose last two changes of the record are alike in all but size, such as the step of
    an integrator of first order, followed to where its changes lead; else as it is.

    Args:
        before: Settings before the last ones.
        records: Those of the last three settings, (N,) each.
    """
    first, last = (fit.problem.whiten_all(b - a) for a, b in pairwise(records))
    ratio = float(np.clip(first @ last / (first @ first), SECOND_ORDER, SLOWEST))
    beyond = ratio / (1.0 - ratio)
    # what is not alike goes on alike at worst
    off = beyond * ((records[2] - records[1]) - ratio * (records[1] - records[0]))
    unsure = numerics_gate(fit, {here.name: off})[0].value
    if not unsure < here.left:
        return here
    like, left = here.finer.numerics, here.left
    while left >= NUMERICS_LAMBDA:  # settings that alone leave as little
        like, left = like.refined(REFINEMENTS[here.name]), ratio * left
    limit = records[2] + beyond * (records[2] - records[1])
    shift, added = _fit_shift(fit, limit, here.finer.shift)
    finer = Finer(here.finer.numerics, shift, before, beyond, like)
    return replace(here, finer=finer, added=added, change=off, unsure=unsure)


def _fit_shift(fit: Fit, record: Array, shift: Array) -> tuple[Array, Array]:
    """Base parameters at which coarse records are most like a finer one, and what is left of it.

    Args:
        fit: Fit with coarse settings, corrected or not.
        record: Finer record of all runs at its end, (N,) [unit of the channel].
        shift: First guess, (num_base,).
    """
    problem = replace(fit.problem, correction=None)
    left = record - problem.record(_point_shifted(fit.x, shift))
    for _ in range(2):
        moved = shift + _shift(fit, left)
        after = record - problem.record(_point_shifted(fit.x, moved))
        if np.linalg.norm(problem.whiten_all(after)) >= np.linalg.norm(problem.whiten_all(left)):
            break
        shift, left = moved, after
    return shift, left


def _point_shifted(x: Array, shift: Array) -> Array:
    """A point, (n,), with its base parameters shifted, (num_base,)."""
    return x + np.pad(shift, (0, len(x) - len(shift)))


def _next(sizes: Sequence[float]) -> float:
    """What one more refinement would change, over the last change; of second order, where one
    change alone is known."""
    if len(sizes) < 2 or sizes[-2] == 0.0:
        return SECOND_ORDER
    return float(np.clip(sizes[-1] / sizes[-2], SECOND_ORDER, SLOWEST))


def _gate(refined: _RefinedSetting, coarse: Numerics) -> GateResult:
    """What a setting still moves; where that is too much, all of what it moves: a correction whose
    end is not in sight holds nowhere else."""
    name, left = refined.name, refined.left
    begun, ended = getattr(coarse, name), getattr(refined.finer.numerics, name)
    if begun == ended:
        note = "noise and prior sd that refining would move, extrapolated"
        return GateResult(name, left < NUMERICS_LAMBDA, left, NUMERICS_LAMBDA, note)
    simulated = f"simulated with {begun:g} times"
    if left < NUMERICS_LAMBDA:
        note = (
            f"noise and prior sd that refining beyond {ended:g} times the model's own would move, "
            f"extrapolated; {simulated} and corrected"
        )
        return GateResult(name, True, left, NUMERICS_LAMBDA, note)
    note = (
        f"noise and prior sd that refining from {begun:g} to {ended:g} times the model's own "
        f"and beyond moves, {figure(left, 2)} of them extrapolated; {simulated}"
    )
    return GateResult(name, False, sum(refined.sizes) + left, NUMERICS_LAMBDA, note)


def _shift(fit: Fit, change: Array) -> Array:
    """(num_base,) parameters that make coarse records most like finer ones."""
    j = fit.jacobian
    moved = posterior_covariance(j) @ (j.T @ fit.problem.whiten_all(change))
    return np.asarray(moved[: fit.problem.num_base])


def renewed_at(fit: Fit) -> tuple[Correction, float]:
    """The correction made at a fit, its shifts too, and how much it differs there.

    A plain model that lacks a large cause may end where finer steps ask for another damping; at
    the answer they ask for none.

    Args:
        fit: Fit of a corrected problem.

    Returns:
        The new correction; and the length of what it changes of the record there, as the numerics
        gate measures it [noise and prior sd].
    """
    problem = fit.problem
    assert problem.correction is not None
    coarse, none = replace(problem, correction=None), np.zeros(problem.num_base)
    here, finer, total = coarse.record(fit.x), [], np.zeros(0)
    for one in problem.correction.finer:
        record = one.record(coarse, fit.x)
        shift, added = none, record - here
        if numerics_gate(fit, {COARSE: added})[0].value >= NEGLIGIBLE:
            # slopes are those of where coarse simulations were, which may be far from no shift
            tried = [_fit_shift(fit, record, first) for first in (none, one.shift)]
            shift, added = min(tried, key=lambda t: float(np.linalg.norm(problem.whiten_all(t[1]))))
        finer.append(replace(one, shift=shift))
        total = total + added if total.size else added
    new = Correction(coarse, fit.x, tuple(finer)).known(problem.runs, total)
    moved = replace(problem, correction=new).record(fit.x) - problem.record(fit.x)
    return new, numerics_gate(fit, {COARSE: moved})[0].value


def corrected_at(
    fit: Fit, at: Linearization, settings: DiagnosisSettings
) -> tuple[CorrectionAt, float]:
    """The correction that the fit of a set asks for, and how much it differs from the one in use.

    Args:
        fit: Fit of a set.
        at: Linearization at its end, base parameters first.
        settings: Budgets of refinement and of the search.

    Returns:
        The correction, and the length of what it changes of the record there [noise sd]: what
        fitted numbers could take up of it counts, too, as it moves them.
    """
    plain = replace(fit, problem=replace(fit.problem, correction=None))
    here = replace(at, x=fit.x, record=plain.problem.record(fit.x))
    once = replace(plain.problem, numerics=None).cost()
    found = find_correction(plain, here, settings, once)
    new = replace(fit.problem, correction=found.correction)
    moved = new.record(fit.x) - fit.problem.record(fit.x)
    return found, length(fit.problem.whiten_all(moved))


def carried(
    at: Linearization, old: Correction | None, new: Correction, runs: Sequence[Run]
) -> Linearization:
    """A linearization under one correction where the same coarse simulation serves under another.

    Args:
        at: Under the old one.
        old, new: Corrections with the same coarse settings; None: there was none.
        runs: Runs of its record.
    """
    base = new.problem.model.values
    shift, added = -new.shift, new.over(runs)
    if old is not None:
        shift, added = shift + old.shift, added - old.over(runs)
    x = _point_shifted(at.x, shift.numpy())
    x[: len(base.low)] = np.clip(x[: len(base.low)], base.low, base.high)
    return replace(at, x=x, record=at.record + added)


def coarse_gate(size: float, problem: Problem, *, is_at_set: bool = False) -> GateResult:
    """What coarse simulations still have wrong at the answer.

    Args:
        is_at_set: The correction was made at a set, else at the plain fit.
    """
    assert problem.correction is not None
    coarse, finest = problem.numerics or Numerics(), problem.correction.finest
    words = [
        f"{what} {getattr(coarse, name) / getattr(finest, name):g} times as coarse"
        for name, what in (("time_step", "time steps"), ("mesh", "cells"))
        if getattr(coarse, name) != getattr(finest, name)
    ]
    before = "an earlier set" if is_at_set else "the plain fit"
    at = f"{before} and at the answer, where {figure(size, 2)} noise sd were left"
    if math.isinf(size):
        at = f"{before}; at the answer they failed"
    note = (
        f"simulated with {' and '.join(words) or 'a looser tolerance'} and corrected by finer "
        f"simulations at {at}"
    )
    name = CORRECTED if is_at_set and size < NUMERICS_LAMBDA else COARSE
    return GateResult(name, size < NUMERICS_LAMBDA, size, NUMERICS_LAMBDA, note)
