"""From a study and a simulator to one verdict with its evidence."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

from diffsim.data.study import Run, Study
from diffsim.diagnose import decide as rules
from diffsim.diagnose.crosscheck import swap_probability
from diffsim.diagnose.decide import Decision, decide
from diffsim.diagnose.effect import Effect
from diffsim.diagnose.evidence import Hypothesis
from diffsim.diagnose.gain import Gain, gain
from diffsim.diagnose.gates import data_gate, gradient_gate, numerics_gate
from diffsim.diagnose.model import SimModel
from diffsim.diagnose.next_run import next_run
from diffsim.diagnose.noise import UNREPEATABLE, NoiseFloor, noise_floor, without_spikes
from diffsim.diagnose.report import GateResult, Report
from diffsim.diagnose.screen import Screen, screen
from diffsim.diagnose.search import Search, SearchSettings
from diffsim.diagnose.tables import cannot_see, effect_rows, hypothesis_rows, set_names
from diffsim.diagnose.unknown import Unknown, drifts
from diffsim.diagnose.words import sentences
from diffsim.identify import Fit, Jacobian, Problem, Whitener, WhiteNoise
from diffsim.identify import fit as fit_runs

Array = NDArray[np.float64]
SWAP_LIMIT = 0.02  # of noise alone: about three of 200 swapped draws may reach the statistic
NOISE_CHANGED = 0.03  # relative; a larger change of the floor asks for another round


@dataclass(frozen=True, kw_only=True)
class DiagnosisSettings:
    """Effort and choices; the thresholds of the verdict are constants of ``decide``.

    Attributes:
        search: Effort of the search.
        jacobian: How to differentiate.
        workers: Threads over runs.
        accept_numerics: Go on although the numerics gate fails.
        noise_rounds: At most; the floor is estimated again after each.
    """

    search: SearchSettings = field(default_factory=SearchSettings)
    jacobian: Jacobian = field(default_factory=Jacobian)
    workers: int = 1
    accept_numerics: bool = False
    noise_rounds: int = 3


@dataclass(frozen=True, eq=False)
class _Case:
    """What every step needs."""

    study: Study
    model: SimModel
    effects: tuple[Effect, ...]
    unknowns: tuple[Unknown, ...]
    settings: DiagnosisSettings

    def fit(self, runs: Sequence[Run], whitener: Whitener, start: Array | None = None) -> Fit:
        s = self.settings
        return fit_runs(
            self.model,
            runs,
            self.study.channels,
            start=start,
            whitener=whitener,
            jacobian=s.jacobian,
            workers=s.workers,
        )

    def wide(self, null: Fit) -> Problem:
        return replace(null.problem, effects=self.effects)


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
    case = _Case(study, model, judged, generic, settings)

    study, noise, null, num_spikes = _null_fit(case)
    case = replace(case, study=study)
    wide = case.wide(null)
    at = np.concatenate([null.x, np.zeros(len(wide.owners))])
    gates += numerics_gate(null) + gradient_gate(wide, at)
    if not settings.accept_numerics and any(
        not g.passed for g in gates if g.name in ("time_step", "mesh", "tolerance")
    ):
        residual, jacobian = wide.linearise(at, screen=True)
        seen = screen(wide, residual, jacobian, at)
        decision = Decision("numerical", frozenset(), (), None, 0.0)
        return _report(
            case, decision, None, null, noise, seen, gates, unmet, seed, bank, num_spikes
        )

    search, noise, null = _search(case, noise, null)
    linear = search.null_linear
    seen = screen(search.wide, linear.residual, linear.jacobian, linear.x0)
    decision = _confirmed(_decide(search), search, gates, seed)
    if not noise.is_repeatable:
        decision = replace(decision, verdict="unrepeatable", rivals=())
    return _report(case, decision, search, null, noise, seen, gates, unmet, seed, bank, num_spikes)


def _null_fit(case: _Case) -> tuple[Study, NoiseFloor, Fit, int]:
    """Fit with rough noise, then spikes out, noise from what is left, and once more."""
    study = case.study
    raw = {r.name: r.measured for r in study.runs}
    channels = [
        c
        if c.sd is not None
        else replace(
            c, sd=noise_floor(study.fit_runs, (c,), {n: m[:, [i]] for n, m in raw.items()}).sd[0]
        )
        for i, c in enumerate(study.channels)
    ]
    rough = case.fit(study.fit_runs, WhiteNoise(channels))
    cleaned = [without_spikes(r, left_of(rough, r)) for r in study.runs]
    num_spikes = sum(count for _, count in cleaned)
    study = replace(study, runs=tuple(run for run, _ in cleaned))
    left = {r.name: left_of(rough, r) for r in study.fit_runs}
    noise = noise_floor(study.fit_runs, study.channels, left)
    return study, noise, case.fit(study.fit_runs, noise.whitener, rough.x), num_spikes


def _search(case: _Case, noise: NoiseFloor, null: Fit) -> tuple[Search, NoiseFloor, Fit]:
    """Search; estimate the noise from what the best set leaves; again if it has changed."""
    runs = case.study.fit_runs
    for round_ in range(case.settings.noise_rounds):
        search = Search(case.wide(null), case.unknowns, null, case.settings.search)
        search.run()
        best = search.entries[Hypothesis(_decide(search).best)].fit
        assert best is not None
        after = noise_floor(runs, case.study.channels, {r.name: left_of(best, r) for r in runs})
        is_same = after.source == noise.source and bool(
            (np.abs(after.sd / noise.sd - 1.0) < NOISE_CHANGED).all()
        )
        if is_same or round_ == case.settings.noise_rounds - 1:
            break
        noise, null = after, case.fit(runs, after.whitener, null.x)
    return search, after, null


def _decide(search: Search) -> Decision:
    entries = search.entries
    null = entries[Hypothesis()].fit
    assert null is not None
    # samples less effectively fitted parameters: tr (J'J) (J'J + 1)^-1
    fitted = null.problem.num_base - float(np.trace(null.covariance))
    return decide(
        {h: e.nats for h, e in entries.items()},
        {h: e.weighed.chi2 for h, e in entries.items() if h.unknown is None},
        null.num_samples - fitted,
    )


def _confirmed(decision: Decision, search: Search, gates: list[GateResult], seed: int) -> Decision:
    """An unknown cause that repeats do not confirm is withdrawn; the check joins the gates."""
    if decision.unknown is None or decision.unknown.unknown is None:
        return decision
    best = search.entries[Hypothesis(decision.best)].fit
    assert best is not None
    cause = search.unknowns[decision.unknown.unknown]
    p = swap_probability(best.problem, best.x, best.residual, cause, seed=seed)
    if p is None:
        return decision
    gates.append(
        GateResult("swap", p <= SWAP_LIMIT, p, SWAP_LIMIT, f"{cause.name}: repeats as noise scale")
    )
    if p <= SWAP_LIMIT:
        return decision
    return replace(decision, verdict="named" if decision.best else "none", unknown=None)


def _report(
    case: _Case,
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
        decision, total, gains = _with_gains(case, decision, search, found, seed)
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
        sentences=sentences(decision, rows, rivals, total, gates, noise, case),
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


def _with_gains(
    case: _Case, decision: Decision, search: Search, best: Fit, seed: int
) -> tuple[Decision, Gain | None, dict[int, Gain]]:
    """Gains on held-out runs; a name whose gain lies below zero is withdrawn."""
    runs = case.study.holdout_runs
    if not runs or not decision.best or decision.verdict not in ("named", "ambiguous"):
        return decision, None, {}
    null = search.entries[Hypothesis()].fit
    assert null is not None
    gains = {}
    for i in decision.best:
        without = search.refit(decision.best - {i})
        if without is not None and without.fit is not None:
            gains[i] = gain(runs, without.fit, best, seed=seed)
    kept = frozenset(i for i in decision.best if i not in gains or gains[i].status != "withdrawn")
    if kept != decision.best:
        verdict = decision.verdict if kept else "unknown"
        decision = replace(decision, best=kept, verdict=verdict)
        entry = search.refit(kept)
        if entry is None or entry.fit is None:
            return replace(decision, best=frozenset(), verdict="unknown"), None, gains
        best = entry.fit
    return decision, gain(runs, null, best, seed=seed) if kept else None, gains


def left_of(fit: Fit, run: Run) -> Array:
    """(num_samples, num_channels) measured minus predicted [unit of the channel]."""
    with torch.no_grad():
        return run.measured - fit.problem.predict(run, torch.from_numpy(fit.x)).numpy()


def _require_distinct(effects: Sequence[Effect]) -> None:
    names = [e.name for e in effects]
    if repeated := sorted({n for n in names if names.count(n) > 1}):
        raise ValueError(f"effects share names: {repeated}; a report could not tell them apart")
