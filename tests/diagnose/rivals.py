"""What is done elsewhere, on the same cases: naive refit, BIC, held-out error, sparse regression.

None of them weighs an unknown cause, says that the data cannot decide, or looks at repeats; all
take the noise as stated, white. `python -m tests.diagnose.rivals runs/confusion.jsonl` holds them
against the verdicts that `tests.diagnose.confusion` wrote.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from diffsim.data.study import Study
from diffsim.diagnose.judge.gain import held_out_residual
from diffsim.identify import Effect, Fit, Problem, SimModel, fit
from tests.diagnose import toy
from tests.diagnose.confusion import Case

Array = np.ndarray
NAIVE_Z = 1.645  # two-sided 90 %
MOST = 3
SHORTLIST = 3
METHODS = ("naive refit", "BIC", "held-out", "sparse")


def rival_names(study: Study, model: SimModel, library: Sequence[Effect]) -> dict[str, list[str]]:
    """Names of every method; an empty list says that nothing is missing."""
    null = fit(model, study.fit_runs, study.channels)
    fits = Fits(null, library)
    return {
        "naive refit": naive_refit(fits),
        "BIC": forward(fits, lambda found: _bic(found, null)),
        "held-out": forward(fits, lambda found: _held_out(found, study)),
        "sparse": sparse(fits),
    }


class Fits:
    """Sets of effects refitted from the plain fit, each once."""

    def __init__(self, null: Fit, library: Sequence[Effect]):
        self.null, self.library = null, tuple(library)
        self._made: dict[frozenset[Effect], Fit] = {frozenset(): null}

    def of(self, effects: Sequence[Effect]) -> Fit:
        """With these effects."""
        key = frozenset(effects)
        if key not in self._made:
            chosen = [e for e in self.library if e in key]
            self._made[key] = fit(
                self.null.problem.model,
                self.null.problem.runs,
                (),
                effects=chosen,
                start=np.concatenate([self.null.x, np.zeros(len(chosen))]),
                whitener=self.null.problem.whitener,
                max_evaluations=15,
            )
        return self._made[key]

    def projected(self, at: Fit) -> tuple[Array, Array]:
        """Residual and slopes of all effects at a fit, what its own columns absorb taken out."""
        p = at.problem
        wide = Problem(p.model, p.runs, p.whitener, self.library)
        x = np.zeros(p.num_base + len(self.library))
        x[: p.num_base] = at.x[: p.num_base]
        for effect in p.effects:
            x[wide.columns_of(effect)] = at.x[p.columns_of(effect)]
        _, jacobian = wide.linearize(x, screen=True)
        q, _ = np.linalg.qr(at.jacobian)
        slopes = jacobian[:, p.num_base :]
        return at.residual - q @ (q.T @ at.residual), slopes - q @ (q.T @ slopes)


def naive_refit(fits: Fits) -> list[str]:
    """Fit every effect at once; all sizes that differ from zero at 90 % are found."""
    full = fits.of(fits.library)
    z = {e.name: full.values[e.name] / full.sd[e.name] for e in fits.library}
    return sorted(name for name in z if abs(z[name]) > NAIVE_Z)


def forward(fits: Fits, score: Callable[[Fit], float]) -> list[str]:
    """Add the effect that lowers the score most, while one does; of those that promise the largest
    drop of chi2."""
    chosen: list[Effect] = []
    while len(chosen) < MOST:
        here = fits.of(chosen)
        residual, slopes = fits.projected(here)
        drop = (slopes.T @ residual) ** 2 / np.maximum(np.sum(slopes**2, axis=0), 1e-9)
        ranked = [fits.library[j] for j in np.argsort(-drop)]
        tried = [e for e in ranked if e not in chosen][:SHORTLIST]
        best = min(tried, key=lambda e: score(fits.of([*chosen, e])))
        if score(fits.of([*chosen, best])) >= score(here):
            break
        chosen.append(best)
    return sorted(e.name for e in chosen)


def sparse(fits: Fits) -> list[str]:
    """Lasso on the slopes at the plain fit, by coordinate descent on columns of unit length; of its
    path the support whose least squares have the best BIC."""
    r, a = fits.projected(fits.null)
    length = np.linalg.norm(a, axis=0)
    a = a / np.where(length > 0.0, length, 1.0)
    w, best, chosen = np.zeros(a.shape[1]), r @ r, np.zeros(0, dtype=int)
    gram, projection = a.T @ a, a.T @ r
    for penalty in np.abs(projection).max() * np.geomspace(0.95, 1e-3, 60):
        w = _lasso(gram, projection, penalty, w, [e.signed for e in fits.library])
        if not len(support := np.flatnonzero(w)):
            continue
        b = a[:, support]
        left = r - b @ np.linalg.lstsq(b, r, rcond=None)[0]
        score = left @ left + len(support) * np.log(len(r))
        if score < best:
            best, chosen = score, support
    return sorted(fits.library[j].name for j in chosen)


def _lasso(gram: Array, projection: Array, penalty: float, w: Array, signed: list[bool]) -> Array:
    w = w.copy()
    for _ in range(500):
        before = w.copy()
        for j in range(len(w)):
            rest = projection[j] - gram[j] @ w + w[j]
            w[j] = np.sign(rest) * max(abs(rest) - penalty, 0.0)
            if not signed[j]:
                w[j] = max(w[j], 0.0)
        if np.abs(w - before).max() < 1e-6 * max(1.0, np.abs(w).max()):
            break
    return w


def _bic(found: Fit, null: Fit) -> float:
    count = len(found.x) - len(null.x)
    return found.chi2 + found.prior + count * float(np.log(found.num_samples))


def _held_out(found: Fit, study: Study) -> float:
    """Sum of squares on the held-out runs, their own nuisances refitted."""
    return sum(float(np.sum(held_out_residual(found, run) ** 2)) for run in study.test_runs)


def outcome(case: Case, names: Sequence[str] | None) -> str:
    """ "right", "wrong", or "false alarm" (a name where there is none to give).

    Args:
        case: With our verdict.
        names: Of another method; None: our verdict.
    """
    has_name = case["kind"] in ("single", "pair", "twins")
    if names is not None:
        is_right = sorted(names) == sorted(case["hidden"]) if has_name else not names
        is_alarm = not has_name
    else:
        is_right = case["right"]
        is_named = case["verdict"] in ("named", "ambiguous")
        is_alarm = not has_name and (is_named or case["kind"] in ("null", "decoy"))
    return "right" if is_right else "false alarm" if is_alarm else "wrong"


def main() -> None:
    """Print the table; write the names beside the cases."""
    path = Path(sys.argv[1])
    done = [json.loads(line) for line in path.read_text().splitlines()]
    with path.with_suffix(".rivals.jsonl").open("w") as file:
        for case in done:
            study = toy.generate(case["seed"], case["hidden"], **case["options"])
            step = 0.02 if case["kind"] == "numerical" else None
            extra = (toy.CLOCK_OFFSET,) if case["kind"] == "twins" else ()
            model = toy.model(study.runs, step)
            case["others"] = rival_names(study, model, toy.LIBRARY + extra)
            file.write(json.dumps(case) + "\n")
            file.flush()
    for method in (None, *METHODS):
        found = Counter(outcome(c, None if method is None else c["others"][method]) for c in done)
        print(f"{method or 'diagnosis':12s}", dict(found))


if __name__ == "__main__":
    main()
