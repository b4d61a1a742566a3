"""What is done elsewhere, on the same cases: naive refit, BIC, held-out error, sparse regression.

None of them weighs an unknown cause, says that the data cannot decide, or looks at repeats; all take
the noise as stated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diffsim.data.study import Study
from diffsim.diagnose import Effect, SimModel, gain
from diffsim.identify import Fit, Problem, WhiteNoise, fit

NAIVE_Z = 1.645  # two-sided 90 %
FEWEST, MOST = 0, 3
METHODS = ("naive refit", "BIC", "held-out", "sparse")


def rival_names(study: Study, model: SimModel, library: Sequence[Effect]) -> dict[str, list[str]]:
    """Names of every method; an empty list says that nothing is missing."""
    null = fit(model, study.fit_runs, study.channels)
    return {
        "naive refit": naive_refit(null, library),
        "BIC": forward(study, null, library, _bic),
        "held-out": forward(study, null, library, _held_out),
        "sparse": sparse(null, library),
    }


def naive_refit(null: Fit, library: Sequence[Effect]) -> list[str]:
    """Fit every effect at once; all sizes that differ from zero at 90 % are found."""
    full = _refit(null, library)
    sizes = {e.name: full.values[e.name] / full.sd[e.name] for e in library}
    return sorted(name for name, z in sizes.items() if abs(z) > NAIVE_Z)


def forward(study: Study, null: Fit, library: Sequence[Effect], score) -> list[str]:
    """Add the effect that improves the score most, while one does."""
    chosen: list[Effect] = []
    best = score(study, null, 0)
    while len(chosen) < MOST:
        tried = {}
        for effect in library:
            if effect not in chosen:
                found = _refit(null, [*chosen, effect])
                tried[effect] = score(study, found, len(chosen) + 1)
        effect = min(tried, key=lambda e: tried[e])
        if tried[effect] >= best:
            break
        best = tried[effect]
        chosen.append(effect)
    return sorted(e.name for e in chosen)


def sparse(null: Fit, library: Sequence[Effect]) -> list[str]:
    """Lasso on the slopes at the plain fit, what base parameters absorb projected out; the penalty
    by BIC (coordinate descent on standardised columns)."""
    problem = Problem(null.problem.model, null.problem.runs, null.problem.whitener, tuple(library))
    x = np.concatenate([null.x, np.zeros(len(library))])
    residual, jacobian = problem.linearise(x, screen=True)
    n = problem.num_base
    q, _ = np.linalg.qr(jacobian[:, :n])
    a = jacobian[:, n:] - q @ (q.T @ jacobian[:, n:])
    length = np.linalg.norm(a, axis=0)
    a = a / np.where(length > 0, length, 1.0)
    r = residual - q @ (q.T @ residual)
    best, chosen = r @ r, np.zeros(0, dtype=int)
    w = np.zeros(a.shape[1])
    for penalty in np.abs(a.T @ r).max() * np.geomspace(0.95, 1e-3, 60):
        for _ in range(200):
            before = w.copy()
            for j in range(len(w)):
                rest = a[:, j] @ (r - a @ w) + w[j]
                w[j] = np.sign(rest) * max(abs(rest) - penalty, 0.0)
                if not library[j].signed:
                    w[j] = max(w[j], 0.0)
            if np.abs(w - before).max() < 1e-6 * max(1.0, np.abs(w).max()):
                break
        support = np.flatnonzero(w)
        if not len(support):
            continue
        b = a[:, support]
        left = r - b @ np.linalg.lstsq(b, r, rcond=None)[0]
        score = left @ left + len(support) * np.log(len(r))
        if score < best:
            best, chosen = score, support
    return sorted(library[j].name for j in chosen)


def _refit(null: Fit, effects: Sequence[Effect]) -> Fit:
    problem = null.problem
    start = np.concatenate([null.x, np.zeros(len(effects))])
    return fit(
        problem.model,
        problem.runs,
        (),
        effects=effects,
        start=start,
        whitener=problem.whitener,
        max_evaluations=15,
    )


def _bic(study: Study, found: Fit, count: int) -> float:
    return found.chi2 + found.prior + count * float(np.log(found.num_samples))


def _held_out(study: Study, found: Fit, count: int) -> float:
    """Sum of squares on the held-out runs, their own nuisances refitted."""
    from diffsim.diagnose.gain import held_out_residual

    return sum(float(np.sum(held_out_residual(found, run) ** 2)) for run in study.holdout_runs)


__all__ = ["METHODS", "Fit", "WhiteNoise", "gain", "rival_names"]
