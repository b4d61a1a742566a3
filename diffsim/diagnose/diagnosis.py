"""From a study and a simulator to one verdict with its evidence."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from diffsim.core.version import __version__
from diffsim.data.study import Run, Study
from diffsim.diagnose import decide as rules
from diffsim.diagnose.decide import Decision
from diffsim.diagnose.evidence import Hypothesis
from diffsim.diagnose.force_map import ForceMap, force_map
from diffsim.diagnose.gate_result import GateResult
from diffsim.diagnose.gates import (
    data_gate,
    gradient_gate,
    numerical_effects,
    numerics_changes,
    numerics_gate,
)
from diffsim.diagnose.judge import NAMES, Judgement, decision_of, judge
from diffsim.diagnose.next_run import next_run
from diffsim.diagnose.noise import UNREPEATABLE, NoiseFloor
from diffsim.diagnose.points import Points
from diffsim.diagnose.repeatability import repeatability_gate
from diffsim.diagnose.report import Report
from diffsim.diagnose.screen import Screen, screen
from diffsim.diagnose.search import NONE, Search
from diffsim.diagnose.stages import (
    Case,
    DiagnosisSettings,
    Progress,
    null_fit,
    search_rounds,
    silent,
)
from diffsim.diagnose.store import Store, key_of
from diffsim.diagnose.tables import cannot_see, effect_rows, hypothesis_rows, set_names
from diffsim.diagnose.words import sentences
from diffsim.identify import Fit
from diffsim.identify.effect import Effect
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown, UnknownForce, drifts

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
    progress: Progress | None = None,
    cache: str | Path | None = None,
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
        progress: Told stage, share done and message as it goes.
        cache: Folder for what was simulated: after an interruption, the same call goes on from
            there. The model's name stands for its code; empty the folder after changing that.

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
    show = progress or silent
    case = Case(study, model, judged, generic, settings, show)
    show("null fit", 0.0, "the model without effects")
    before = model.simulations.count
    case, noise, null, num_spikes = null_fit(case)
    show("checks", 0.15, "numerical settings, gradients")
    changes = numerics_changes(null.fit.problem, null.local)
    gates += numerics_gate(null.fit, changes)
    if settings.accept_numerics:
        case = replace(case, effects=(*case.effects, *numerical_effects(null.fit, changes)))
    if cache is not None:
        case = replace(case, store=Store(cache, _key(case)))
    points = Points(case.wide(null.fit), store=case.store)
    points.keep(NONE, null.local)
    screened = points.linear(NONE, points.screen(NONE, None), (), 1)
    gates += gradient_gate(screened)
    found = _Found(case, null.fit, noise, gates, unmet, num_spikes, changes, before)
    if not settings.accept_numerics and any(
        not g.passed for g in gates if g.name in ("time_step", "mesh", "tolerance")
    ):
        seen = screen(screened.problem, screened.residual, screened.jacobian, screened.x0)
        decision = Decision("numerical", frozenset(), (), None, 0.0)
        return _report(found, Judgement(decision, None, {}, frozenset()), None, seen, seed, bank)

    search, noise, null = search_rounds(case, noise, null, points)
    linear = search.null_linear
    seen = screen(search.wide, linear.residual, linear.jacobian, linear.x0)
    show("gain", 0.88, "runs held out")
    evident = decision_of(search)
    best = search.entries[Hypothesis(evident.best)].fit
    assert best is not None  # sets without an unknown cause are fitted
    repeats = repeatability_gate(best)
    gates += repeats
    if noise.is_repeatable and all(g.passed for g in repeats):
        judgement = judge(search, case.study.holdout_runs, gates, seed)
    else:
        decision = replace(evident, verdict="unrepeatable", rivals=())
        judgement = Judgement(decision, None, {}, frozenset())
    return _report(replace(found, null=null.fit, noise=noise), judgement, search, seen, seed, bank)


@dataclass(frozen=True, eq=False)
class _Found:
    """What the steps before the search left for the report."""

    case: Case
    null: Fit
    noise: NoiseFloor
    gates: list[GateResult]
    unmet: dict[str, str]
    num_spikes: int
    changes: dict[str, Array]
    simulations_before: int


def _report(
    found: _Found,
    judgement: Judgement,
    search: Search | None,
    seen: Screen,
    seed: int,
    bank: Sequence[Run],
) -> Report:
    case, null, noise, gates = found.case, found.null, found.noise, found.gates
    decision, total, gains = judgement.decision, judgement.gain, judgement.gains
    is_named = decision.verdict in NAMES
    best = null
    if search is not None and is_named:
        kept = search.entries[Hypothesis(decision.best)].fit
        assert kept is not None  # sets without an unknown cause are fitted
        best = kept
        if not best.converged:
            why = f"of the named set: its sizes are not to be trusted ({best.message})"
            gates.append(GateResult("fit_converged", False, 0.0, 1.0, why))
    effects = case.effects
    rivals = tuple(set_names(h, effects, case.unknowns) for h in decision.rivals)
    rival_fits = [best] + [
        search.entries[h].fit for h in decision.rivals if search and h.unknown is None
    ]
    fits = [f for f in rival_fits if f is not None]
    advice = next_run(fits, bank) if bank and len(fits) > 1 else None
    rows = effect_rows(effects, decision, search, seen, gains, judgement.withdrawn, found.changes)
    case.progress("done", 1.0, decision.verdict)
    return Report(
        verdict=decision.verdict,
        sentences=sentences(decision, rows, rivals, total, gates, noise, effects, case.unknowns),
        named=tuple(effects[i].name for i in sorted(decision.best)) if is_named else (),
        rivals=rivals,
        hypotheses=hypothesis_rows(search, effects, case.unknowns),
        table=rows,
        confounding_names=seen.names,
        confounding=seen.confounding,
        cannot_see=cannot_see(case.study, effects, seen, found.unmet),
        gates=tuple(gates),
        noise={
            "sd": dict(zip([c.name for c in case.study.channels], noise.sd.tolist(), strict=True)),
            "source": noise.source,
            "scatter_ratio": noise.scatter_ratio,
            "num_spikes": found.num_spikes,
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
            "num_simulations": case.model.simulations.count - found.simulations_before,
            "search": asdict(case.settings.search),
            **({} if search is None else _trouble(search)),
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
        force_map=None if search is None else _force_map(search),
    )


def _trouble(search: Search) -> dict[str, list[str]]:
    """Sets that did not go as they should."""

    def name(h: Hypothesis) -> str:
        return " + ".join(set_names(h, search.wide.effects, search.unknowns)) or "no effect"

    entries = search.entries.items()
    return {
        "could_not_be_simulated": [name(h) for h in search.failed],
        "not_converged": [name(h) for h, e in entries if e.fit and not e.fit.converged],
        "slopes_borrowed_at": [name(Hypothesis(m)) for m in search.borrowed],
    }


def _force_map(search: Search) -> ForceMap | None:
    """Of the first unknown force, at the plain model; its slopes were simulated for the search."""
    for u, cause in enumerate(search.unknowns):
        slopes = search.points.forces.get((NONE, u))
        if isinstance(cause, UnknownForce) and slopes is not None:
            return force_map(search.wide, cause, slopes, search.null_linear.residual)
    return None


def _key(case: Case) -> str:
    """Of everything that changes a simulation."""
    causes = [(e.name, type(e).__qualname__, e.typical, e.components) for e in case.effects]
    generic = [(u.name, type(u).__qualname__) for u in case.unknowns]
    return key_of(case.study, case.model, causes, generic, case.settings.jacobian, __version__)


def _require_distinct(effects: Sequence[Effect]) -> None:
    names = [e.name for e in effects]
    if repeated := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"effects share names: {repeated}; a report could not tell them apart")
