"""Numerical settings, refined until the gate passes or a budget is spent.

A diagnosis with coarse settings would name causes for what the solver does wrong. So each setting
that moves the record by more than its limit is refined, as long as one simulation costs less than
``DiagnosisSettings.refine_budget`` times what it did. All that follows uses the refined settings.

Steps that follow the plain model may be too coarse for a cause, such as friction that fades within
a fraction of the usual velocity, and another cause would be named for the rest. So the gate is
asked again at the best set of a search (``check_numerics_of_set``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.figures import figure
from diffsim.diagnose.checks.gates import GateResult
from diffsim.identify import Fit, Problem
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.gaussian import Gaussian
from diffsim.identify.linearization import ROUNDING, Linearization
from diffsim.identify.numerics import REFINEMENTS, NumericalEffect, Numerics, coarse

NUMERICS_LAMBDA = 2.0
# Of what a cause does, from which refining a setting once could be the cause: all further
# refinements of a first-order method change as much again, and near kinks none are in proportion.
NUMERICS_SHARE = 0.25
NUMERICS_GATES = ("time_step", "mesh", "tolerance")
OF_NAMES = "; with the named causes"  # where a gate was asked


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
        out[name] = replace(problem, numerics=finer).record(at.x) - at.record
        while getattr(finer, name) >= 1.0 and _is_rounding(problem, out[name]):
            finer = finer.refined(REFINEMENTS[name])
            out[name] = replace(problem, numerics=finer).record(at.x) - at.record
    return out


def _is_rounding(problem: Problem, change: Array) -> bool:
    return length(problem.whiten_all(change)) < ROUNDING


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
        change = fit.problem.whiten_all(raw)
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


def could_be_misfit(fit: Fit, gates: Sequence[GateResult]) -> bool:
    """Whether a numerical setting that failed could be a good part of what a fit leaves.

    Args:
        fit: Fit of the plain model.
        gates: The numerics gate there, other checks aside.
    """
    misfit = math.sqrt(max(fit.chi2 - fit.num_samples, 0.0))
    failed = (g.value for g in gates if g.name in NUMERICS_GATES and not g.passed)
    return any(moved > NUMERICS_SHARE * misfit for moved in failed)


def could_be(fit: Fit, i: int, change: Array) -> float:
    """Length of a whitened change of the record, all but a cause refitted; 0 where it is little of
    what the cause does.

    Args:
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
    if not np.isfinite(slopes).all():  # nothing is known of it
        return np.full(len(change) + slopes.shape[1], np.nan)
    taken = Gaussian.of(slopes, change).mean
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
        total += (posterior_covariance(j) @ (j.T @ fit.problem.whiten_all(raw))) ** 2
    return np.asarray(np.sqrt(total))


@dataclass(frozen=True, eq=False)
class SetNumerics:
    """Numerical settings at the fit of a set of causes."""

    # change of the record by refining each setting, by its name, (N,) each
    changes: dict[str, Array]
    gates: tuple[GateResult, ...]  # one per setting
    may_refine: bool = False  # whether a setting fails, and finer ones are within the budget


def check_numerics_of_set(fit: Fit, record: Array, settings: DiagnosisSettings) -> SetNumerics:
    """Check the numerical settings at the fit of a set of causes.

    Args:
        record: Its prediction, (N,).
        settings: Budget of refinement.
    """
    problem = fit.problem
    here = Linearization(fit.x, record, (), np.zeros((len(record), 0)))
    changes = numerics_changes(problem, here)
    gates = tuple(numerics_gate(fit, changes))
    used, once = problem.numerics or Numerics(), replace(problem, numerics=None).cost()
    costs = [
        replace(problem, numerics=used.refined(REFINEMENTS[name])).cost()
        for name in names_of_failed(gates)
    ]
    budget = settings.refine_budget
    may_refine = budget > 1.0 and min(costs, default=math.inf) <= budget * once
    noted = note_numerics(gates, problem.numerics, problem.cost() / once, budget, not may_refine)
    noted = tuple(replace(g, note=g.note + OF_NAMES) for g in noted)
    return SetNumerics(changes, noted, may_refine)


def refine_within(
    fit: Fit,
    budget: float,
    changes: dict[str, Array],
    gates: tuple[GateResult, ...],
    once: float,
) -> tuple[Numerics, dict[str, Array], tuple[GateResult, ...], float]:
    """Settings from which the gate passes at the same parameters, within the budget.

    Args:
        fit: Fit whose parameters are kept.
        budget: Cost of a simulation over the plain one, at most.
        changes: Change of the record by refining each setting, by its name, (N,) each.
        gates: The numerics gate, which fails.
        once: Weighted steps of a plain simulation.

    Returns:
        The settings, the changes and gates there, and the cost of a simulation over the plain one.
    """
    problem, x, paid = fit.problem, fit.x, 1.0
    numerics = problem.numerics or Numerics()
    unaffordable: set[str] = set()  # beyond the budget: what is left of it goes to the others
    while failing := [name for name in names_of_failed(gates) if name not in unaffordable]:
        record = None
        for name in failing:
            finer = numerics.refined(REFINEMENTS[name])
            tried = replace(problem, numerics=finer)
            if tried.cost() > budget * once:
                unaffordable.add(name)
            else:
                numerics, paid, record = finer, tried.cost() / once, tried.record(x)
        if record is None:
            break
        there = Linearization(x, record, (), np.zeros((len(record), 0)))
        # what passed is checked again at the next fit
        changes = {
            **changes,
            **numerics_changes(replace(problem, numerics=numerics), there, failing),
        }
        gates = tuple(numerics_gate(fit, changes))
    return numerics, changes, gates, paid


def names_of_failed(gates: Sequence[GateResult]) -> list[str]:
    """Settings that move the record by more than their limit."""
    return [g.name for g in gates if not g.passed]


def note_numerics(
    gates: Sequence[GateResult],
    numerics: Numerics | None,
    paid: float,
    budget: float,
    is_spent: bool = True,
) -> tuple[GateResult, ...]:
    """Gates with a note on how fine the settings in use are, and what they cost.

    Args:
        numerics: Settings in use; None: the model's own.
        paid: Cost of a simulation over the plain one.
        budget: Largest such cost.
        is_spent: Whether finer settings than those in use were beyond the budget.
    """
    out = []
    for gate in gates:
        factor = getattr(numerics or Numerics(), gate.name)
        note = gate.note
        if factor > 1.0:
            note += f"; {factor:g} times as coarse as the model's own"
        if factor < 1.0:
            note += (
                f"; refined by {1.0 / factor:g}, a simulation costs {figure(paid, 2)} times as much"
            )
        if not gate.passed and is_spent:
            note += f"; finer would cost more than the budget of {budget:g} times"
        out.append(replace(gate, note=note))
    return tuple(out)
