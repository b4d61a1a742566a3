"""Numerical settings, refined until the gate passes or a budget is spent.

A diagnosis with coarse settings would name causes for what the solver does wrong. So each setting
that moves the record by more than its limit is refined, as long as one simulation costs less than
``DiagnosisSettings.refine_budget`` times what it did. All that follows uses the refined settings.

Steps that follow the plain model may be too coarse for a cause, such as friction that fades within
a fraction of the usual velocity, and another cause would be named for the rest. So the gate is
asked again at the best set of a search (``numerics_of``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import process_time

import numpy as np
from numpy.typing import NDArray

from diffsim.diagnose.fit import Null
from diffsim.diagnose.gates import GateResult, numerics_changes, numerics_gate
from diffsim.diagnose.gauss_newton import gauss_newton
from diffsim.diagnose.noise import noise_floor
from diffsim.identify import Fit, Problem
from diffsim.identify.linearization import (
    Linearization,
    linearization_at,
    record_at,
    residuals_by_run,
)
from diffsim.identify.numerics import REFINEMENTS, Numerics

Array = NDArray[np.float64]
MAX_REFITS = 3  # of the plain model: each may show that settings are still too coarse for it
TIMINGS = 2  # of the plain simulation; the shorter counts


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


@dataclass(frozen=True, eq=False)
class SetNumerics:
    """Numerical settings at the fit of a set of causes.

    Attributes:
        changes: Change of the record by refining each setting, by its name, (N,) each.
        gates: The numerics gate there.
        finer: Settings from which it passes, or the finest within the budget; None: it passes, or
            none finer are allowed.
    """

    changes: dict[str, Array]
    gates: tuple[GateResult, ...]
    finer: Numerics | None

    def postponed(self) -> SetNumerics:
        """The same, where no further search is made with the finer settings."""
        left = "; the search was not repeated with finer settings"
        gates = (g if g.passed else replace(g, note=g.note + left) for g in self.gates)
        return SetNumerics(self.changes, tuple(gates), None)


def numerics_of(null: Null, fit: Fit, record: Array, *, is_late: bool = False) -> SetNumerics:
    """Check the settings at the fit of a set of causes.

    Args:
        null: The plain model under the settings in use.
        fit: Fit of the set.
        record: Its prediction, (N,).
        is_late: Nobody will search with finer settings: ``finer`` is no more than some within the
            budget, from which the gate may not pass yet.
    """
    here = Linearization(fit.x, record, (), np.zeros((len(record), 0)))
    changes = numerics_changes(fit.problem, here)
    gates = tuple(numerics_gate(fit, changes))
    settings, used = null.case.settings, fit.problem.numerics or Numerics()
    finer, paid = used, 1.0
    if not settings.accept_numerics and settings.refine_budget > 1.0 and _failing(gates):
        own = replace(fit.problem, numerics=None)
        once = min(_timed(own, fit.x)[1] for _ in range(TIMINGS))
        # what refined settings cost is said of them
        is_enough = is_late and not any(getattr(used, name) < 1.0 for name in REFINEMENTS)
        budget = settings.refine_budget
        finer, _, _, paid = _refined(fit, budget, changes, gates, once, is_any_enough=is_enough)
    noted = _noted(gates, fit.problem.numerics, paid, settings.refine_budget, finer == used)
    noted = tuple(replace(g, note=f"{g.note}; with the named causes") for g in noted)
    return SetNumerics(changes, noted, None if finer == used else finer)


def checked_numerics(null: Null) -> Refined:
    """Check the settings at the null fit; refine and fit again where the gate fails.

    Args:
        null: The plain model, fitted with the model's own settings.
    """
    changes = numerics_changes(null.fit.problem, null.at)
    gates = tuple(numerics_gate(null.fit, changes))
    settings = null.case.settings
    if settings.accept_numerics or settings.refine_budget <= 1.0 or not _failing(gates):
        gates = _noted(gates, null.fit.problem.numerics, 1.0, settings.refine_budget)
        return Refined(null, changes, gates)
    once = min(_timed(null.fit.problem, null.at.x)[1] for _ in range(TIMINGS))
    paid = 1.0
    for _ in range(MAX_REFITS):
        null.case.progress("null fit", 0.1, f"refining {', '.join(_failing(gates))}")
        numerics, changes, gates, ratio = _refined(
            null.fit, settings.refine_budget, changes, gates, once
        )
        paid = max(paid, ratio)
        if numerics == (null.fit.problem.numerics or Numerics()):
            break  # the budget allows no finer ones
        null = under(null, numerics)
        changes = numerics_changes(null.fit.problem, null.at)
        gates = tuple(numerics_gate(null.fit, changes))
        if not _failing(gates):
            break
    return Refined(
        null, changes, _noted(gates, null.fit.problem.numerics, paid, settings.refine_budget)
    )


def _refined(
    fit: Fit,
    budget: float,
    changes: dict[str, Array],
    gates: tuple[GateResult, ...],
    once: float,
    *,
    is_any_enough: bool = False,
) -> tuple[Numerics, dict[str, Array], tuple[GateResult, ...], float]:
    """Settings from which the gate passes at the same parameters, within the budget; or any finer
    ones within it, where these are enough.

    Returns:
        The settings, the changes and gates there, and the cost of a simulation over the plain one.
    """
    problem, x, paid = fit.problem, fit.x, 1.0
    numerics = problem.numerics or Numerics()
    dear: set[str] = set()  # beyond the budget: what is left of it goes to the others
    while failing := [name for name in _failing(gates) if name not in dear]:
        record = None
        for name in failing:
            finer = numerics.refined(REFINEMENTS[name])
            tried, seconds = _timed(replace(problem, numerics=finer), x)
            if seconds > budget * once:
                dear.add(name)
            else:
                numerics, paid, record = finer, seconds / once, tried
                if is_any_enough:
                    return numerics, changes, gates, paid
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


def under(null: Null, numerics: Numerics) -> Null:
    """The plain model fitted again under other settings, with the noise of what it leaves."""
    case = replace(null.case, numerics=numerics)
    problem = case.problem(null.noise.whitener)
    fit, at = gauss_newton(problem, linearization_at(problem, null.at.x))
    residuals = residuals_by_run(case.study.fit_runs, at.record)
    noise = noise_floor(case.study.fit_runs, case.study.channels, residuals)
    return replace(null, case=case, fit=fit, at=at).under(noise)


def _failing(gates: Sequence[GateResult]) -> list[str]:
    return [g.name for g in gates if not g.passed]


def _timed(problem: Problem, x: Array) -> tuple[Array, float]:
    """Record at x and the CPU seconds that it took."""
    start = process_time()
    record = record_at(problem, x)
    return record, max(process_time() - start, 1e-9)


def _noted(
    gates: Sequence[GateResult],
    numerics: Numerics | None,
    paid: float,
    budget: float,
    is_spent: bool = True,
) -> tuple[GateResult, ...]:
    out = []
    for gate in gates:
        factor = getattr(numerics or Numerics(), gate.name)
        note = gate.note
        if factor > 1.0:
            note += f"; {factor:g} times as coarse as the model's own"
        if factor < 1.0:
            note += f"; refined by {1.0 / factor:g}, a simulation costs {paid:.2g} times as much"
        if not gate.passed and is_spent:
            note += f"; finer would cost more than the budget of {budget:g} times"
        out.append(replace(gate, note=note))
    return tuple(out)
