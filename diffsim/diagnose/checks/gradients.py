"""Gradients of the simulator against differences, for a tenth of the work of a diagnosis.

The slopes of the linearization cost nothing here. An adjoint costs several simulations, so few runs
are asked: as many as show every effect, more within a budget, and the gate says how many. The
adjoint is asked for slopes along the residual and along every effect's own slopes together: along
the residual alone an error of an effect that explains little of it would not show.

What was simulated for the fit serves as far as it goes: central differences are good to the second
order; slopes of another method are held against differences along directions that move many effects
alike. One direction holds all; where it disagrees, halves are asked, down to single effects.
Differences have two errors: steps too long for a curved response, steps too short for a solver's
tolerance. So lengths are tried, and a direction agrees if it does at any of them: a wrong slope
does at none.

Effects with kinks are not compared: differences across a kink say nothing of either side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from diffsim.core.arrays import Array, Mask
from diffsim.core.errors import DiffsimError
from diffsim.diagnose.checks.gates import GateResult
from diffsim.identify import Jacobian, Problem
from diffsim.identify.effect import Effect
from diffsim.identify.linearization import ROUNDING
from diffsim.identify.model import has_tangents

GRADIENT_RTOL = 1e-4
EXACT = 1e-9  # an error below it is rounding, another one on each machine: none
# of the work that null fit and screening took; a diagnosis takes some times that
GRADIENT_SHARE = 0.25
ADJOINT_SHARE = 0.5  # of the work of the check; the rest is for differences
SHOWN = 0.5  # of an effect's largest slope over the runs: such a run shows it
LENGTHS = (0.5, 0.1, 2.5)  # of the step of the differences
LEFT_OUT = "gradient:not checked"


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Slopes of some runs, as the linearization has them."""

    problem: Problem  # the problem of these runs alone
    x: Array  # standardized coordinates, (n,)
    # residual, jacobian: their rows, whitened, (num_valid,) and (num_valid, n)
    residual: Array
    jacobian: Array
    cotangent: Array  # what the adjoint is asked for, (num_valid,)

    @property
    def scores(self) -> Array:
        """What the adjoint should answer, (n,)."""
        return np.asarray(self.jacobian.T @ self.cotangent)

    def moved(self, effect: Effect) -> float:
        """How far an effect moves the record [noise sd per coordinate]."""
        return float(np.linalg.norm(self.jacobian[:, self.problem.columns_of(effect)]))

    @classmethod
    def joined(cls, parts: Sequence[_Slopes]) -> _Slopes:
        """Those of several runs together."""
        runs = tuple(run for part in parts for run in part.problem.runs)
        return cls(
            replace(parts[0].problem, runs=runs),
            parts[0].x,
            np.concatenate([part.residual for part in parts]),
            np.concatenate([part.jacobian for part in parts]),
            np.concatenate([part.cotangent for part in parts]),
        )


def gradient_gate(
    problem: Problem, x: Array, residual: Array, jacobian: Array, steps: float = np.inf
) -> list[GateResult]:
    """Adjoint score of every effect against differences; skipped where the scene has no gradient.

    Args:
        problem: Problem with all candidates.
        x: Standardized coordinates of the null fit, (n,).
        residual, jacobian: Whitened, with the slopes of all candidates, (num_valid,) and
            (num_valid, n).
        steps: Weighted steps that the check may take beyond its first run; what it leaves out is
            said.
    """
    tally = problem.model.simulations
    start = tally.steps
    rows = zip(problem.runs, problem.by_run(residual), problem.by_run(jacobian), strict=True)
    parts = [
        _Slopes(replace(problem, runs=(run,)), x, r, j, _cotangent(problem, r, j))
        for run, r, j in rows
    ]
    whole = _Slopes.joined(parts)
    effects = [e for e in problem.effects if e.smooth and whole.moved(e) > ROUNDING]
    if not effects:
        return []
    moved = np.array([[part.moved(e) for e in effects] for part in parts])
    shows = moved >= SHOWN * moved.max(0)
    order = _order_runs(shows, [len(part.residual) for part in parts])
    first, leaf = parts[order[0]].problem, torch.tensor(x, requires_grad=True)
    if not first.predict(first.runs[0], leaf).requires_grad:
        return []  # the scene has no gradient
    adjoint, checked = np.zeros(len(x)), []
    for place in order:
        adjoint += parts[place].problem.pullback(x, parts[place].cotangent)
        checked.append(place)
        if tally.steps > start + ADJOINT_SHARE * steps:
            break
    shown = [e for e, there in zip(effects, shows[checked].any(0), strict=True) if there]
    some = _Slopes.joined([parts[place] for place in checked])
    errors, late = _compare_adjoint(some, shown, adjoint, start + steps)
    note = "adjoint against finite differences"
    if len(checked) < len(parts):
        note += f", {len(checked)} of {len(parts)} runs"
    told = {e: errors[e] if errors[e] > EXACT else 0.0 for e in shown if e not in late}
    gates = [
        GateResult(f"gradient:{e.name}", error < GRADIENT_RTOL, error, GRADIENT_RTOL, note)
        for e, error in told.items()
    ]
    if left_out := [e.name for e in effects if e not in shown or e in late]:
        note = f"of {', '.join(left_out)}: it would cost more than a tenth of the diagnosis"
        gates.append(GateResult(LEFT_OUT, False, len(left_out), 0.0, note, applies=False))
    return gates


def _cotangent(problem: Problem, residual: Array, jacobian: Array) -> Array:
    """The residual and the slopes of all smooth effects, each of length one, with weights of either
    sign: slopes that nearly cancel are still seen."""
    smooth = [i for e in problem.effects if e.smooth for i in problem.columns_of(e)]
    rng = np.random.default_rng(0)
    weights = rng.uniform(1.0, 2.0, len(smooth)) * rng.choice([-1.0, 1.0], len(smooth))
    return _unit(-residual) + sum(
        (w * _unit(jacobian[:, i]) for w, i in zip(weights, smooth, strict=True)),
        np.zeros(len(residual)),
    )


def _unit(values: Array) -> Array:
    length = float(np.linalg.norm(values))
    return values / length if length > 0.0 else values


def _order_runs(shows: Mask, lengths: Sequence[int]) -> list[int]:
    """Runs in the order in which they are checked: few and short ones show every effect first.

    Args:
        shows: Whether an effect moves a run about as much as any, (num_runs, num_effects).
        lengths: Number of samples of each run.
    """
    order, missing = [], np.ones(shows.shape[1], dtype=bool)
    left = sorted(range(len(lengths)), key=lambda place: lengths[place])
    while left:
        gained = [(shows[place] & missing).sum() / max(lengths[place], 1) for place in left]
        order.append(left.pop(int(np.argmax(gained))))
        missing &= ~shows[order[-1]]
    return order


def _compare_adjoint(
    slopes: _Slopes, effects: Sequence[Effect], adjoint: Array, end: float
) -> tuple[dict[Effect, float], set[Effect]]:
    """Errors of the adjoint over the length of an effect's slopes, and the effects for which the
    budget was spent."""
    problem, scores = slopes.problem, slopes.scores

    def error(effect: Effect, wanted: Array) -> float:
        off = float(np.linalg.norm(adjoint[problem.columns_of(effect)] - wanted))
        return off / slopes.moved(effect)

    errors = {e: error(e, scores[problem.columns_of(e)]) for e in effects}
    alike = [e for e in effects if errors[e] < GRADIENT_RTOL]
    method = problem.jacobian.method
    if method == "auto" and not has_tangents(problem.model):
        method = "differences"
    # slopes that are differences themselves need not be held against any
    sound = set(alike) if method == "differences" else _sound(slopes, alike, end)
    late: set[Effect] = set()
    doubted = sorted((e for e in effects if e not in sound), key=lambda e: -errors[e])
    for effect in doubted:
        # an adjoint that disagrees is followed up, whatever the budget: the largest error at least
        if problem.model.simulations.steps > end and (effect is not doubted[0] or effect in alike):
            late.add(effect)
            continue
        errors[effect] = np.inf
        # of the step: dry friction of a light joint is bent within a thousandth of its usual size
        for share in (1.0, 0.2, 0.02, 0.001):
            wanted = _extrapolate_scores(slopes, problem.columns_of(effect), share)
            errors[effect] = min(errors[effect], error(effect, wanted))
            if errors[effect] < GRADIENT_RTOL:
                break
    return errors, late


def _sound(slopes: _Slopes, effects: Sequence[Effect], end: float) -> set[Effect]:
    """Effects whose slopes are the differences, halved; others are not, or the budget is over."""
    if not effects:
        return set()
    if _agrees_along(slopes, effects):
        return set(effects)
    if len(effects) == 1 or slopes.problem.model.simulations.steps > end:
        return set()
    half = len(effects) // 2
    return _sound(slopes, effects[:half], end) | _sound(slopes, effects[half:], end)


def _agrees_along(slopes: _Slopes, effects: Sequence[Effect]) -> bool:
    """Whether slopes are the differences along a direction in which every component moves the
    record alike, so that one wrong column among n shows by at least 1 / sqrt(n) of its error.

    Upwards only, as sizes may have a sign: (-11 f0 + 18 f1 - 9 f2 + 2 f3) / 6h, third order. Slopes
    are themselves central differences of what is cheap, wrong by about step^2 / 6 of the third
    derivative, (f3 - 3 f2 + 3 f1 - f0) / h^3: so much is allowed, at most as much again.
    """
    problem, x = slopes.problem, slopes.x
    idx = [i for e in effects for i in problem.columns_of(e)]
    lengths = np.linalg.norm(slopes.jacobian[:, idx], axis=0)
    idx = [i for i, length in zip(idx, lengths, strict=True) if length > 0.0]
    lengths = lengths[lengths > 0.0]
    direction = np.zeros(len(x))
    # none further than a prior standard deviation, however little it moves
    direction[idx] = np.minimum(np.median(lengths) / lengths, 1.0)
    predicted = slopes.jacobian @ direction
    limit = GRADIENT_RTOL / np.sqrt(len(idx)) * float(np.linalg.norm(predicted))
    step = problem.jacobian.step
    for share in LENGTHS:
        h = share * step
        try:
            f1, f2, f3 = (problem.residual(x + k * h * direction) for k in (1, 2, 3))
        except DiffsimError:  # too far for this simulator
            continue
        f0 = slopes.residual
        off = -(-11.0 * f0 + 18.0 * f1 - 9.0 * f2 + 2.0 * f3) / (6.0 * h) - predicted
        third = float(np.linalg.norm(f3 - 3.0 * f2 + 3.0 * f1 - f0)) / h**3
        # shorter lengths show the solver's tolerance instead of a third derivative
        own = min(step**2 / 6.0 * third, limit) if share >= LENGTHS[0] else 0.0
        if float(np.linalg.norm(off)) <= limit + own:
            return True
    return False


def _extrapolate_scores(slopes: _Slopes, only: list[int], share: float) -> Array:
    """Scores of some coordinates by differences of two steps, extrapolated (Richardson): good to
    the fourth (third, one-sided) order; ``share`` of the problem's own step."""
    step, scores = share * slopes.problem.jacobian.step, []
    for h in (step, step / 2):
        finer = replace(slopes.problem, jacobian=Jacobian(method="differences", step=h))
        scores.append(finer.linearize(slopes.x, only=only)[1].T @ slopes.cotangent)
    return np.asarray((4.0 * scores[1] - scores[0]) / 3.0)
