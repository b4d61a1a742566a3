"""Gradients of the simulator against differences, in a tenth of the time of a diagnosis.

The slopes of the linearization cost nothing here. Central differences are good to the second order;
slopes of another method are held against differences along directions that move many effects alike.
One direction holds all; where it disagrees, halves are asked, down to single effects. Differences
have two errors: steps too long for a curved response, steps too short for a solver's tolerance. So
lengths are tried, and a direction agrees if it does at any of them: a wrong slope does at none.

Effects with kinks are not compared: differences across a kink say nothing of either side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from time import process_time

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.core.errors import DiffsimError
from diffsim.diagnose.evidence import LaplaceEvidence
from diffsim.diagnose.gates import ROUNDING, GateResult
from diffsim.identify import Jacobian, Problem
from diffsim.identify.effect import Effect
from diffsim.identify.model import has_tangents

Array = NDArray[np.float64]
GRADIENT_RTOL = 1e-4
# of the time that null fit and screening took; a diagnosis takes some times that
GRADIENT_SHARE = 0.25
LENGTHS = (0.5, 0.1, 2.5)  # of the step of the differences
LEFT_OUT = "gradient:not checked"


def gradient_gate(linear: LaplaceEvidence, seconds: float = np.inf) -> list[GateResult]:
    """Adjoint score of every effect against differences; skipped where the scene has no gradient.

    Args:
        linear: Whitened slopes of all candidates at the null fit.
        seconds: CPU time that the check may take beyond its first direction [s]; what it leaves out
            is said.
    """
    problem, x, residual = linear.problem, linear.x0, linear.residual
    moved = {
        e: float(np.linalg.norm(linear.jacobian[:, problem.columns_of(e)]))
        for e in problem.effects
        if e.smooth
    }
    effects = [e for e, length in moved.items() if length > ROUNDING]
    if not effects or not _has_gradient(problem, x):
        return []
    end = process_time() + seconds
    _, adjoint = problem.gradient(x)
    score = -linear.jacobian.T @ residual
    # relative to the largest score a residual of this length could have
    size = {e: float(np.linalg.norm(residual)) * moved[e] for e in effects}

    def error(effect: Effect, scores: Array) -> float:
        c = problem.columns_of(effect)
        return float(np.linalg.norm(adjoint[c] - scores) / size[effect])

    errors = {e: error(e, score[problem.columns_of(e)]) for e in effects}
    alike = [e for e in effects if errors[e] < GRADIENT_RTOL]
    sound = set(alike) if _are_differences(problem) else _sound(linear, alike, end)
    left_out = []
    for effect in effects:
        if effect in sound:
            continue
        if process_time() > end:
            left_out.append(effect)
            continue
        errors[effect] = error(effect, _extrapolated(problem, x, problem.columns_of(effect)))
    gates = [_result(e, errors[e]) for e in effects if e not in left_out]
    if left_out:
        names = ", ".join(e.name for e in left_out)
        note = f"of {names}: differences would take more than a tenth of the diagnosis"
        gates.append(GateResult(LEFT_OUT, False, len(left_out), 0.0, note, applies=False))
    return gates


def _result(effect: Effect, error: float) -> GateResult:
    note = "adjoint against finite differences"
    passed = error < GRADIENT_RTOL
    return GateResult(f"gradient:{effect.name}", passed, error, GRADIENT_RTOL, note)


def _are_differences(problem: Problem) -> bool:
    method = problem.jacobian.method
    return method == "differences" or (method == "auto" and not has_tangents(problem.model))


def _sound(linear: LaplaceEvidence, effects: Sequence[Effect], end: float) -> set[Effect]:
    """Effects whose slopes are the differences, by halves; the others are not, or time is over."""
    if not effects:
        return set()
    if _agrees_along(linear, effects):
        return set(effects)
    if len(effects) == 1 or process_time() > end:
        return set()
    half = len(effects) // 2
    return _sound(linear, effects[:half], end) | _sound(linear, effects[half:], end)


def _agrees_along(linear: LaplaceEvidence, effects: Sequence[Effect]) -> bool:
    """Whether slopes are the differences along a direction in which every component moves the
    record alike, so that one wrong column among n shows by at least 1 / sqrt(n) of its error.

    Upwards only, as sizes may have a sign: (-11 f0 + 18 f1 - 9 f2 + 2 f3) / 6h, third order. Slopes
    are themselves central differences of what is cheap, wrong by about step^2 / 6 of the third
    derivative, (f3 - 3 f2 + 3 f1 - f0) / h^3: so much is allowed, at most as much again.
    """
    problem, x = linear.problem, linear.x0
    idx = [i for e in effects for i in problem.columns_of(e)]
    lengths = np.linalg.norm(linear.jacobian[:, idx], axis=0)
    idx = [i for i, length in zip(idx, lengths, strict=True) if length > 0.0]
    lengths = lengths[lengths > 0.0]
    direction = np.zeros(len(x))
    # none further than a prior standard deviation, however little it moves
    direction[idx] = np.minimum(np.median(lengths) / lengths, 1.0)
    predicted = linear.jacobian @ direction
    limit = GRADIENT_RTOL / np.sqrt(len(idx)) * float(np.linalg.norm(predicted))
    step = problem.jacobian.step
    for share in LENGTHS:
        h = share * step
        try:
            f1, f2, f3 = (problem.residual(x + k * h * direction) for k in (1, 2, 3))
        except DiffsimError:  # too far for this simulator
            continue
        f0 = linear.residual
        off = -(-11.0 * f0 + 18.0 * f1 - 9.0 * f2 + 2.0 * f3) / (6.0 * h) - predicted
        third = float(np.linalg.norm(f3 - 3.0 * f2 + 3.0 * f1 - f0)) / h**3
        # shorter lengths show the solver's tolerance instead of a third derivative
        own = min(step**2 / 6.0 * third, limit) if share >= LENGTHS[0] else 0.0
        if float(np.linalg.norm(off)) <= limit + own:
            return True
    return False


def _extrapolated(problem: Problem, x: Array, only: list[int]) -> Array:
    """Scores of some coordinates by differences of two steps, extrapolated (Richardson): good to
    the fourth (third, one-sided) order."""
    step, scores = problem.jacobian.step, []
    for h in (step, step / 2):
        residual, jacobian = replace(
            problem, jacobian=Jacobian(method="differences", step=h)
        ).linearize(x, only=only)
        scores.append(-jacobian[:, only].T @ residual)
    return np.asarray((4.0 * scores[1] - scores[0]) / 3.0)


def _has_gradient(problem: Problem, x: Array) -> bool:
    leaf = torch.tensor(x, requires_grad=True)
    return bool(problem.predict(problem.runs[0], leaf).requires_grad)
