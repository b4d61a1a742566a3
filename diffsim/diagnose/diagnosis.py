"""From a study and a simulator to one verdict with its evidence."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from diffsim.core.version import __version__
from diffsim.data.study import Run, Study
from diffsim.diagnose.evidence import ALONE_NATS, KEEP_NATS, Hypothesis
from diffsim.diagnose.fit import Case, Null, Progress, null_fit, silent
from diffsim.diagnose.force_map import ForceMap, force_map
from diffsim.diagnose.gates import (
    NUMERICS_GATES,
    GateResult,
    data_gate,
    gradient_gate,
    numerical_effects,
    numerics_changes,
    numerics_gate,
    repeatability_gate,
)
from diffsim.diagnose.judge import EXPLAINED, NAMES, Decision, Judgment, decision_of, judge
from diffsim.diagnose.next_run import next_run
from diffsim.diagnose.noise import UNREPEATABLE, noise_floor
from diffsim.diagnose.outside import spans_of
from diffsim.diagnose.referee import referee_of
from diffsim.diagnose.report import Report, sentences
from diffsim.diagnose.screen import Screen, screen
from diffsim.diagnose.search import Search, begin, search_sets
from diffsim.diagnose.simulations import NONE, Center, Simulations
from diffsim.diagnose.store import Store, key_of
from diffsim.diagnose.tables import cannot_see, effect_rows, hypothesis_rows, set_names
from diffsim.diagnose.unseen import on_unseen
from diffsim.identify.effect import Effect
from diffsim.identify.effort import DiagnosisSettings
from diffsim.identify.linearization import residuals_by_run
from diffsim.identify.model import SimModel
from diffsim.identify.unknown import Unknown, UnknownForce, drifts

Array = NDArray[np.float64]
NOISE_CHANGED = 0.03  # relative; a larger change of the floor asks for another round


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
        model: Simulator with everything imperfectly known as base parameters, nuisances of the
            set-up too: a forgotten one becomes an invented effect.
        effects: Candidate causes.
        seed: Seed of the bootstrap.
        unknowns: Generic causes that the system supplies (``UnknownForce``); a smooth drift of each
            channel is always among them.
        bank: Runs that could be recorded next.
        settings: Effort of the diagnosis; None: the defaults of ``DiagnosisSettings``.
        progress: Receives stage, share done and message.
        cache: Folder for what was simulated: after an interruption, the same call goes on from
            there. The model's name stands for its code; empty the folder after changing that.

    Returns:
        The verdict with its evidence.

    Raises:
        ValueError: the study cannot be judged at all, or effects share a name.
    """
    gates = data_gate(study)
    # from here to the end of the search nothing can look at a test run: there is none
    case = _case(study.without_tests(), model, effects, unknowns, settings, progress)
    case.progress("null fit", 0.0, "the model without effects")
    null = null_fit(case)
    null.case.progress("checks", 0.15, "numerical settings, gradients")
    null, checks, simulations = _checked(null, gates, cache)
    if checks.numerics_failed and not null.case.settings.accept_numerics:
        decision = Decision("numerical", frozenset(), (), None, 0.0)
        screened = _screened(checks.center)
        return _tested(_report(null, checks, Judgment(decision), screened, seed, bank), study, seed)
    search = search_rounds(null, simulations)
    screened = _screened(search.plain)
    case.progress("gain", 0.88, "unseen runs")
    checks, judgment = _judged(search, checks, seed)
    # the answer is frozen here; only now test runs are looked at, once
    return _tested(_report(search.null, checks, judgment, screened, seed, bank), study, seed)


def _tested(report: Report, study: Study, seed: int) -> Report:
    """The frozen answer on test runs, and on select runs where there is none of them."""
    seen = report.study
    use = "test" if study.test_runs else "select"
    runs = study.test_runs or seen.select_runs
    sd = np.array(list(report.noise["sd"].values()))
    spans = spans_of(seen.fit_runs, seen.channels)
    found = on_unseen(report.null, report.best, runs, seen.channels, sd, spans, seed=seed, use=use)
    is_test = use == "test" and bool(report.best.problem.effects)
    return replace(
        report,
        study=replace(study, runs=(*seen.runs, *study.test_runs)),
        errors=found.errors,
        outside=found.outside,
        gain=found.gain if is_test else None,
    )


@dataclass(frozen=True, eq=False)
class Checks:
    """Gates before any physics is blamed, and what they simulated.

    Attributes:
        gates: Data, numerical settings, gradients; then repeatability and the judgment's.
        changes: Change of the record by refining each numerical setting, by its name, (N,) [unit of
            the channel].
        center: The plain model with everything linearized there.
    """

    gates: tuple[GateResult, ...]
    changes: dict[str, Array]
    center: Center

    @property
    def numerics_failed(self) -> bool:
        """Whether numerical settings move the record by more than their limit."""
        return any(not g.passed for g in self.gates if g.name in NUMERICS_GATES)

    def joined(self, more: Sequence[GateResult]) -> Checks:
        """The checks with further gates."""
        return replace(self, gates=(*self.gates, *more))


def search_rounds(null: Null, simulations: Simulations) -> Search:
    """Search; estimate the noise from what the best set leaves; again if it has changed, from what
    was simulated before."""
    case = null.case
    for round_ in range(case.settings.noise_rounds):
        search = search_sets(begin(null, simulations))
        simulations = search.simulations
        best = simulations.fitted[decision_of(search).best]
        residuals = residuals_by_run(case.study.fit_runs, best.record)
        after = noise_floor(case.study.fit_runs, case.study.channels, residuals)
        is_same = after.source == null.noise.source and bool(
            (np.abs(after.sd / null.noise.sd - 1.0) < NOISE_CHANGED).all()
        )
        if is_same or round_ == case.settings.noise_rounds - 1:
            break
        null = null.under(after)
    # the report shows the floor that the best set leaves
    return replace(search, null=replace(null, noise=after))


def _case(
    study: Study,
    model: SimModel,
    effects: Sequence[Effect],
    unknowns: Sequence[Unknown],
    settings: DiagnosisSettings | None,
    progress: Progress | None,
) -> Case:
    """Candidates that these data allow to be judged, and a drift of each channel."""
    names = [e.name for e in effects]
    if repeated := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"effects share names: {repeated}; a report could not distinguish them")
    unmet = {e.name: why for e in effects if (why := e.needs(study)) is not None}
    return Case(
        study=study,
        model=model,
        effects=tuple(e for e in effects if e.name not in unmet),
        unknowns=(*unknowns, *drifts([c.name for c in study.channels])),
        settings=settings or DiagnosisSettings(),
        progress=progress or silent,
        unmet=unmet,
        num_simulated=model.simulations.count,
    )


def _checked(
    null: Null, gates: tuple[GateResult, ...], cache: str | Path | None
) -> tuple[Null, Checks, Simulations]:
    """Numerical settings and gradients at the null fit, everything linearized there."""
    changes = numerics_changes(null.fit.problem, null.at)
    gates = (*gates, *numerics_gate(null.fit, changes))
    case = null.case
    if case.settings.accept_numerics:
        case = replace(case, effects=(*case.effects, *numerical_effects(null.fit, changes)))
    if cache is not None:
        case = replace(case, store=Store(cache, _key(case)))
    null = replace(null, case=case)
    simulations = Simulations(null.wide, case.store).under(null)
    at, simulations = simulations.screen(NONE, None)
    center = simulations.center(NONE, at, 1)
    gates = (*gates, *gradient_gate(center.evidence))
    return null, Checks(gates, changes, center), simulations


def _screened(center: Center) -> Screen:
    e = center.evidence
    return screen(e.problem, e.residual, e.jacobian, e.x0)


def _judged(search: Search, checks: Checks, seed: int) -> tuple[Checks, Judgment]:
    """Repeatability with the effects that the evidence asks for; then names and unknown causes."""
    evident = decision_of(search)
    repeats = repeatability_gate(search.fit_of(evident.best))
    checks = checks.joined(repeats)
    if search.null.noise.is_repeatable and all(g.passed for g in repeats):
        select = search.null.case.study.select_runs
        judgment = judge(search, referee_of(search.fit_of(NONE).problem, select), seed)
        return checks.joined(judgment.gates), judgment
    decision = replace(evident, verdict="unrepeatable", rivals=())
    return checks, Judgment(decision, search)


def _report(
    null: Null,
    checks: Checks,
    judgment: Judgment,
    screened: Screen,
    seed: int,
    bank: Sequence[Run],
) -> Report:
    case, noise, gates = null.case, null.noise, checks.gates
    decision, search = judgment.decision, judgment.search
    is_named = search is not None and decision.verdict in NAMES
    best = null.fit
    if search is not None and is_named:
        best = search.fit_of(decision.best)
        if not best.converged:
            why = f"of the named set: its sizes are not to be trusted ({best.message})"
            gates = (*gates, GateResult("fit_converged", False, 0.0, 1.0, why))
    effects = case.effects
    rivals = tuple(set_names(h, effects, case.unknowns) for h in decision.rivals)
    rival_fits = [best]
    if search is not None:
        rival_fits += [search.fit_of(h.effects) for h in decision.rivals if h.unknown is None]
    advice = next_run(rival_fits, bank) if bank and len(rival_fits) > 1 else None
    rows = effect_rows(effects, judgment, screened, checks.changes)
    case.progress("done", 1.0, decision.verdict)
    return Report(
        verdict=decision.verdict,
        sentences=sentences(
            decision, rows, rivals, judgment.gain, gates, noise, effects, case.unknowns
        ),
        named=tuple(effects[i].name for i in sorted(decision.best)) if is_named else (),
        rivals=rivals,
        hypotheses=hypothesis_rows(search, effects, case.unknowns),
        table=rows,
        confounding_names=screened.names,
        confounding=screened.confounding,
        cannot_see=cannot_see(effects, screened, case.unmet),
        gates=gates,
        noise={
            "sd": dict(zip([c.name for c in case.study.channels], noise.sd.tolist(), strict=True)),
            "source": noise.source,
            "scatter_ratio": noise.scatter_ratio,
            "num_spikes": null.num_spikes,
        },
        gain=judgment.gain,
        chi2_null=null.fit.chi2,
        chi2_best=best.chi2,
        num_samples=null.fit.num_samples,
        settings=_settings(case, search, seed),
        null=null.fit,
        best=best,
        study=case.study,
        model=case.model,
        next_run=advice,
        force_map=None if search is None else _force_map(search),
    )


def _settings(case: Case, search: Search | None, seed: int) -> dict[str, Any]:
    """Thresholds, seed, effort, versions."""
    return {
        "seed": seed,
        "keep_nats": KEEP_NATS,
        "alone_nats": ALONE_NATS,
        "explained": EXPLAINED,
        "unrepeatable": UNREPEATABLE,
        "num_simulations": case.model.simulations.count - case.num_simulated,
        "search": asdict(case.settings.search),
        **({} if search is None else _trouble(search)),
        "versions": {
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "torch": torch.__version__,
        },
    }


def _trouble(search: Search) -> dict[str, list[str]]:
    """Sets that failed, did not converge, or borrowed slopes."""

    def name(h: Hypothesis) -> str:
        return " + ".join(set_names(h, search.wide.effects, search.unknowns)) or "no effect"

    weighed = search.weighed.items()
    return {
        "could_not_be_simulated": [name(h) for h in search.failed],
        "not_converged": [name(h) for h, w in weighed if w.fit and not w.fit.converged],
        "slopes_borrowed_at": [name(Hypothesis(m)) for m in search.borrowed],
    }


def _force_map(search: Search) -> ForceMap | None:
    """Map of the first unknown force, at the plain model; its slopes were simulated for the
    search."""
    for u, cause in enumerate(search.unknowns):
        slopes = search.simulations.unknown_slopes.get((NONE, u))
        if isinstance(cause, UnknownForce) and slopes is not None:
            return force_map(search.wide, cause, slopes, search.plain.evidence.residual)
    return None


def _key(case: Case) -> str:
    """Hash of everything that changes a simulation."""
    causes = [(e.name, e.kind, e.unit, e.typical, e.components) for e in case.effects]
    generic = [(u.name, type(u).__qualname__) for u in case.unknowns]
    return key_of(case.study, case.model, causes, generic, case.settings.jacobian, __version__)
