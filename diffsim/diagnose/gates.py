"""Checks before any physics is blamed: data, gradients, numerics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from diffsim.data.study import Study
from diffsim.diagnose.evidence import Linearisation
from diffsim.diagnose.model import Numerics
from diffsim.diagnose.report import GateResult
from diffsim.identify import Fit, Jacobian, Problem
from diffsim.identify.fitting import posterior_covariance

Array = NDArray[np.float64]
GRADIENT_RTOL = 1e-4
NUMERICS_LAMBDA = 2.0
REFINEMENTS = {
    "time_step": Numerics(time_step=0.5),
    "mesh": Numerics(mesh=0.5),
    "tolerance": Numerics(tolerance=0.1),
}


def data_gate(study: Study) -> list[GateResult]:
    """Clocks increasing, shapes, at least two commands, at least one held-out run.

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
    commands = len({r.group for r in study.fit_runs})
    held_out = len(study.holdout_runs)
    repeats = len(study.fit_runs) - commands
    return [
        GateResult("commands", commands >= 2, commands, 2, "different commands among the fit runs"),
        GateResult("held_out", held_out >= 1, held_out, 1, "runs never used for fitting"),
        GateResult("repeats", repeats >= 1, repeats, 1, "without them repeatability is not judged"),
    ]


def gradient_gate(linear: Linearisation) -> list[GateResult]:
    """Adjoint score of every effect against differences; skipped where the scene has no gradient.

    The slopes of the linearisation are central differences, good to the second order, and cost
    nothing here. Only an effect that disagrees is differenced again, at the usual step and half of
    it, extrapolated (Richardson): good to the fourth (third, one-sided) order. Slopes of another
    method are not differences; then all effects are.

    Args:
        linear: At the null fit.
    """
    problem, x, residual = linear.problem, linear.x0, linear.residual
    effects = [e for e in problem.effects if e.smooth]
    if not effects or not _has_gradient(problem, x):
        return []
    _, adjoint = problem.gradient(x)
    score = -linear.jacobian.T @ residual
    out = []
    for effect in effects:
        c = problem.columns_of(effect)
        # relative to the largest score a residual of this length could have
        size = np.linalg.norm(residual) * np.linalg.norm(linear.jacobian[:, c])
        if size == 0.0:
            continue
        error = float(np.linalg.norm(adjoint[c] - score[c]) / size)
        if error >= GRADIENT_RTOL or problem.jacobian.method != "differences":
            error = float(np.linalg.norm(adjoint[c] - _extrapolated(problem, x, c)) / size)
        out.append(
            GateResult(
                f"gradient:{effect.name}",
                error < GRADIENT_RTOL,
                error,
                GRADIENT_RTOL,
                "adjoint against finite differences",
            )
        )
    return out


def _extrapolated(problem: Problem, x: Array, only: list[int]) -> Array:
    """Scores of some coordinates by differences of two steps."""
    step, scores = problem.jacobian.step, []
    for h in (step, step / 2):
        residual, jacobian = replace(problem, jacobian=Jacobian(step=h)).linearise(x, only=only)
        scores.append(-jacobian[:, only].T @ residual)
    return np.asarray((4.0 * scores[1] - scores[0]) / 3.0)


def numerics_gate(fit: Fit) -> list[GateResult]:
    """How far refining each numerical setting moves the record, in noise units.

    lambda = |(1 - J (J'J + 1)^-1 J') W (S(refined) - S)|: what base parameters cannot absorb.
    """
    problem, j = fit.problem, fit.jacobian
    out = []
    for name, finer in REFINEMENTS.items():
        change = fit.residual - replace(problem, numerics=finer).residual(fit.x)
        left = change - j @ (posterior_covariance(j) @ (j.T @ change))
        size = float(np.linalg.norm(left))
        out.append(
            GateResult(
                name,
                size < NUMERICS_LAMBDA,
                size,
                NUMERICS_LAMBDA,
                "noise sd that refining moves the record, refit allowed",
            )
        )
    return out


def _has_gradient(problem: Problem, x: Array) -> bool:
    leaf = torch.tensor(x, requires_grad=True)
    return bool(problem.predict(problem.runs[0], leaf).requires_grad)
