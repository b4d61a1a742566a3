"""What a model's first samples show: no numbers at all, causes that act at size 0."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from diffsim.data.study import Study
from diffsim.data.study_check import Problem
from diffsim.identify.setup import DiagnosisSetup

FIRST = 8  # samples that are simulated: a moment's work
_FORMULAS = ("ode", "bench")


def trial_problems(study: Study, setup: DiagnosisSetup) -> Iterator[Problem]:
    """Mistakes of formulas that only their values show.

    Args:
        study: Study with the description; only systems of formulas are tried.
        setup: What the description made.
    """
    if (study.model or {}).get("system") not in _FORMULAS:
        return
    model, q = setup.model, setup.model.at_prior()
    runs = [run.part(slice(FIRST)) for run in study.runs if len(run.time_s)]
    for run in runs:
        if not bool(torch.isfinite(model.predict(run, q)).all()):
            yield Problem(
                "error",
                f"run {run.name}",
                "the model gives no number at its first samples; is there a division by 0, or a "
                "root or logarithm of a negative number?",
            )
            return
    own = {e.get("name") for e in ((study.model or {}).get("effects") or {}).get("own") or ()}
    for effect in (e for e in setup.effects if e.name in own):
        nothing = {effect: torch.zeros(len(effect.components), dtype=torch.float64)}
        for run in runs:
            plain, with_it = model.predict(run, q), model.predict(run, q, nothing)
            if not torch.allclose(plain, with_it, rtol=1e-9, atol=1e-12):
                yield Problem(
                    "error",
                    f"model.effects.own {effect.name}",
                    "it acts although its size is 0; write it so that size 0 changes nothing",
                )
                break
