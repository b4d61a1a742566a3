"""How visible a hidden cause was: lambda and delta, simulated from data without noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.cli.diagnose_inputs import inputs_of
from diffsim.core.threads import one_thread
from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.gain import gain
from diffsim.diagnose.search.fit import Case, Null, null_fit, residual_of
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Fit
from diffsim.identify.effect import Effect
from diffsim.identify.linearization import linearization_at
from labs.blind.sealed import Bench, study_of

LARGE_EXCESS = 0.05  # noise variances per sample; below it a share of the excess means nothing


@one_thread
def score_simulated(
    bench: Bench,
    label: Mapping[str, Any],
    folder: Path,
    score: Mapping[str, Any],
    setup_file: Path | None = None,
) -> dict[str, Any]:
    """Lambda and delta of what was hidden, and the gain of the true extended model.

    lambda^2 of a cause, each given the others, is what it adds to the least chi2 + prior of the
    model without it. lambda^2 / 2 are the nats that naming it can gain, whether it shows as a
    misfit or pulls base parameters off their data sheets; ``misfit`` counts the former alone.

    Args:
        bench: The laboratory; makes the data again without noise.
        label: What was hidden.
        folder: Of the case's data.
        score: Of ``score_answer``.
        setup_file: As the diagnosis had it.
    """
    inputs = inputs_of(load_study(folder), seed=0, setup_file=setup_file)
    by_name = {e.name: e for e in inputs.setup.effects}
    true = {name: sizes for name, sizes in score["truth"].items() if sizes is not None}
    null = _null(inputs)
    clean, _ = study_of(bench, label, noise=0.0)
    out: dict[str, Any] = {"lambda": {}, "misfit": {}}
    for hidden, names in _own_names(label, score["truth"]).items():
        rest = {name: size for name, size in label["effects"].items() if name != hidden}
        without, _ = study_of(bench, {**label, "effects": rest}, noise=0.0)
        others = [by_name[n] for n in true if n not in names]
        left, plain = _fitted(null, clean, others), _fitted(null, without, others)
        added = left.chi2 + left.prior - plain.chi2 - plain.prior
        strength = float(np.sqrt(max(added, 0.0)))
        out["lambda"] |= dict.fromkeys(names, strength)
        out["misfit"] |= dict.fromkeys(names, float(np.sqrt(left.chi2)))
        out["delta"] = _delta(null, clean, left)
    tests = inputs.study.test_runs
    if len(true) == len(score["truth"]) and true and tests and score["gain"] is not None:
        best = _fitted(null, null.case.study, [by_name[n] for n in true])
        found = gain(tests, null.fit, best, seed=inputs.seed)
        out["true_gain"] = found.value
        if found.value > 0.0 and found.excess > LARGE_EXCESS:
            out["share_of_true_gain"] = score["gain"][0] / found.value
    return out


def _own_names(label: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, tuple[str, ...]]:
    """The library's names of every effect of the label: "weak_rotor" -> ("weak_rotor_2",)."""
    out = {}
    for hidden in label["effects"]:
        places = tuple(n for n in truth if n.rstrip("0123456789") == f"{hidden}_")
        out[hidden] = (hidden,) if hidden in truth else places
    return out


def _null(inputs: Inputs) -> Null:
    setup = inputs.setup
    study = inputs.study.without_tests()
    return null_fit(Case(study, setup.model, setup.effects, setup.unknowns, setup.settings))


def _fitted(null: Null, study: Study, effects: Sequence[Effect]) -> Fit:
    """The plain model with some effects, from its fit to the noisy data and weighed as these."""
    problem = replace(null.fit.problem, runs=study.fit_runs, effects=tuple(effects))
    x = np.zeros(len(problem.names))
    x[: problem.num_base] = null.fit.x
    return gauss_newton(problem, linearization_at(problem, x))[0]


def _delta(null: Null, clean: Study, left: Fit) -> float:
    """Rms of the misfit over one sample's noise sd."""
    sd = null.noise.sd
    parts = [(residual_of(left, run) / sd).ravel() for run in clean.fit_runs]
    return float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2)))
