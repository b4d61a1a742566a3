"""From a study and a simulator to one verdict with its evidence."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from diffsim.data.study import Run, Study
from diffsim.diagnose import decide as rules
from diffsim.diagnose.decide import Decision
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.evidence import Hypothesis
from diffsim.diagnose.gain import Gain
from diffsim.diagnose.gates import data_gate, gradient_gate, numerics_gate
from diffsim.diagnose.model import SimModel
from diffsim.diagnose.next_run import next_run
from diffsim.diagnose.noise import UNREPEATABLE, NoiseFloor
from diffsim.diagnose.points import Points
from diffsim.diagnose.report import GateResult, Report
from diffsim.diagnose.screen import Screen, screen
from diffsim.diagnose.search import NONE, Search
from diffsim.diagnose.stages import (
    Case,
    DiagnosisSettings,
    confirmed,
    decision_of,
    null_fit,
    search_rounds,
    with_gains,
)
from diffsim.diagnose.tables import cannot_see, effect_rows, hypothesis_rows, set_names
from diffsim.diagnose.unknown import Unknown, drifts
from diffsim.diagnose.words import sentences
from diffsim.identify import Fit

Array = NDArray[np.float64]


def diagnose(
    study: Study,
    model: SimModel,
    effects: Sequence[Effect],
    *,
    seed: int,
    unknowns: Sequence[Unknown] = (),
    bank: Sequence[Run] = (),
    settings: DiagnosisSettings | None = None,
) -> Report:
    """Find what the simulator gets wrong.

    Args:
        study: Recorded runs, some of them held out.
        model: With everything imperfectly known as base parameters, nuisances of the set-up too: a
            forgotten one becomes an invented effect.
        effects: Candidates.
        seed: Of the bootstrap.
        unknowns: Generic causes that the bed supplies (``UnknownForce``); a smooth drift of each
            channel is always among them.
        bank: Runs that could be recorded next.
        settings: Effort.

    Returns:
        ``Report``.

    Raises:
        ValueError: the study cannot be judged at all, or effects share a name.
    """
    settings = settings or DiagnosisSettings()
    gates = data_gate(study)
    _require_distinct(effects)
    unmet = {e.name: why for e in effects if (why := e.needs(study)) is not None}
    judged = tuple(e for e in effects if e.name not in unmet)
    generic = (*unknowns, *drifts([c.name for c in study.channels]))
    case = Case(study, model, judged, generic, settings)

    case, noise, null, num_spikes = null_fit(case)
    gates += numerics_gate(null.fit)
    points = Points(case.wide(null.fit))
    points.keep(NONE, null.local)
    screened = points.linear(NONE, points.screen(NONE, None), (), 1)
    gates += gradient_gate(screened)
    if not settings.accept_numerics and any(
        not g.passed for g in gates if g.name in ("time_step", "mesh", "tolerance")
    ):
        seen = screen(screened.problem, screened.residual, screened.jacobian, screened.x0)
        decision = Decision("numerical", frozenset(), (), None, 0.0)
        return _report(
            case, decision, None, null.fit, noise, seen, gates, unmet, seed, bank, num_spikes
        )

    search, noise, null = search_rounds(case, noise, null, points)
    linear = search.null_linear
    seen = screen(search.wide, linear.residual, linear.jacobian, linear.x0)
    decision = confirmed(decision_of(search), search, gates, seed)
    if not noise.is_repeatable:
        decision = replace(decision, verdict="unrepeatable", rivals=())
    return _report(
        case, decision, search, null.fit, noise, seen, gates, unmet, seed, bank, num_spikes
    )


def _report(
    case: Case,
    decision: Decision,
    search: Search | None,
    null: Fit,
    noise: NoiseFloor,
    seen: Screen,
    gates: list[GateResult],
    unmet: dict[str, str],
    seed: int,
    bank: Sequence[Run],
    num_spikes: int,
) -> Report:
    gains: dict[int, Gain] = {}
    total: Gain | None = None
    best = null
    if search is not None:
        found = search.entries[Hypothesis(decision.best)].fit
        assert found is not None
        decision, total, gains = with_gains(case, decision, search, found, seed)
        kept = search.entries[Hypothesis(decision.best)].fit
        best = kept if kept is not None and decision.verdict in ("named", "ambiguous") else null
    effects = case.effects
    rivals = tuple(set_names(h, effects, case.unknowns) for h in decision.rivals)
    rival_fits = [best] + [
        search.entries[h].fit for h in decision.rivals if search and h.unknown is None
    ]
    fits = [f for f in rival_fits if f is not None]
    advice = next_run(fits, bank) if bank and len(fits) > 1 else None
    is_named = decision.verdict in ("named", "ambiguous")
    rows = effect_rows(effects, decision, search, seen, gains)
    return Report(
        verdict=decision.verdict,
        sentences=sentences(decision, rows, rivals, total, gates, noise, effects),
        named=tuple(effects[i].name for i in sorted(decision.best)) if is_named else (),
        rivals=rivals,
        hypotheses=hypothesis_rows(search, effects, case.unknowns),
        table=rows,
        confounding_names=seen.names,
        confounding=seen.confounding,
        cannot_see=cannot_see(case.study, effects, seen, unmet),
        gates=tuple(gates),
        noise={
            "sd": dict(zip([c.name for c in case.study.channels], noise.sd.tolist(), strict=True)),
            "source": noise.source,
            "scatter_ratio": noise.scatter_ratio,
            "num_spikes": num_spikes,
        },
        gain=total,
        chi2_null=null.chi2,
        chi2_best=best.chi2,
        num_samples=null.num_samples,
        settings={
            "seed": seed,
            "keep_nats": rules.KEEP_NATS,
            "alone_nats": rules.ALONE_NATS,
            "explained": rules.EXPLAINED,
            "unrepeatable": UNREPEATABLE,
            "num_simulations": case.model.simulations.count,
            "search": asdict(case.settings.search),
            "could_not_be_simulated": []
            if search is None
            else [" + ".join(set_names(h, effects, case.unknowns)) for h in search.failed],
            "versions": {
                "python": platform.python_version(),
                "numpy": np.__version__,
                "scipy": scipy.__version__,
                "torch": torch.__version__,
            },
        },
        null=null,
        best=best,
        study=case.study,
        model=case.model,
        next_run=None if advice is None else asdict(advice),
    )


def _require_distinct(effects: Sequence[Effect]) -> None:
    names = [e.name for e in effects]
    if repeated := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"effects share names: {repeated}; a report could not tell them apart")
