"""The frozen answer as a report, then its errors on test runs."""

from __future__ import annotations

import platform
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import scipy
import torch

from diffsim.core.arrays import Array
from diffsim.core.errors import DiffsimError
from diffsim.data.shown import resolution_words
from diffsim.data.study import Run, Study
from diffsim.diagnose.checks.gates import (
    MUCH_LEFT,
    MUCH_UNSEEN,
    REPEATED,
    GateResult,
    contradiction_gate,
)
from diffsim.diagnose.checks.noise import UNREPEATABLE
from diffsim.diagnose.checks.numerics import NUMERICS_GATES, SetNumerics
from diffsim.diagnose.judge.apart import apart_in_fit
from diffsim.diagnose.judge.averaging import averaged, widening
from diffsim.diagnose.judge.band import band_of
from diffsim.diagnose.judge.crosscheck import repeated_gate
from diffsim.diagnose.judge.data_sheet import (
    base_rows,
    misfit_unheld,
    ranges_of_answer,
    told_away,
)
from diffsim.diagnose.judge.gain import Gain, Validation
from diffsim.diagnose.judge.judge import EXPLAINED, NAMES, Judgment
from diffsim.diagnose.judge.own_values import own_words, unmet_by
from diffsim.diagnose.judge.preconditions import (
    OTHERS_UNDO_IT,
    Grounds,
    doubts_of,
    doubts_of_fit,
    doubts_of_names,
    doubts_of_unseen,
    singled_out,
    wrong_gradients,
)
from diffsim.diagnose.judge.records import (
    CERTAIN,
    EFFECT,
    LIKELY,
    UNTOLD,
    BaseRow,
    CauseRow,
    ErrorRow,
)
from diffsim.diagnose.judge.stand_ins import own_steps, without_forms, without_wrong_data_sheets
from diffsim.diagnose.judge.unseen import constants_of, on_unseen, spans_of
from diffsim.diagnose.say.causes import REST, CauseEvidence, cause_rows, open_rivals, ranked
from diffsim.diagnose.say.factors import is_same_factor
from diffsim.diagnose.say.force_map import ForceMap, force_map
from diffsim.diagnose.say.headline import headline
from diffsim.diagnose.say.next_run import next_run
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.tables import cannot_see, effect_rows, hypothesis_rows, set_names
from diffsim.diagnose.say.wording import BeforeTest, sentences
from diffsim.diagnose.search.evidence import ALONE_NATS, Hypothesis, Screen
from diffsim.diagnose.search.fit import Null
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.search import refit, with_numerics
from diffsim.diagnose.search.simulations import NONE, Center, Members
from diffsim.identify import Fit
from diffsim.identify.effect import Effect
from diffsim.identify.effort import FIRST_STEPS, KEEP_NATS
from diffsim.identify.unknown import UnknownForce


@dataclass(frozen=True, eq=False)
class Checks:
    """Gates before any physics is blamed, and what they simulated."""

    # data, numerical settings, gradients; then repeatability and the judgment's
    gates: tuple[GateResult, ...]
    # change of the record by refining each numerical setting, by its name, (N,) [unit of the
    # channel]
    changes: dict[str, Array]
    center: Center  # the plain model with everything linearized there

    @property
    def unrefined(self) -> dict[str, Array]:
        """Changes by refining settings for which the gate failed."""
        failed = [g.name for g in self.gates if g.name in NUMERICS_GATES and not g.passed]
        return {name: self.changes[name] for name in failed if name in self.changes}

    def at_set(self, found: SetNumerics | None) -> Checks:
        """The checks with numerical settings as they are at the fit of a set of causes.

        Args:
            found: What was found there; None: nothing was checked.
        """
        if found is None:
            return self
        now = {g.name: g for g in found.gates}
        gates = tuple(now.get(g.name, g) for g in self.gates)
        return replace(self, gates=gates, changes=found.changes)

    def joined(self, more: Sequence[GateResult]) -> Checks:
        """The checks with further gates."""
        return replace(self, gates=(*self.gates, *more))


def report_of(
    null: Null,
    checks: Checks,
    judgment: Judgment,
    screened: Screen,
    seed: int,
    bank: Sequence[Run],
    validation: Validation | None = None,
) -> Report:
    """The answer of a diagnosis, before any test run is looked at.

    Args:
        checks: Gates, and what they simulated.
        judgment: The verdict and the search behind it.
        screened: Scores of all candidates at the plain model.
        validation: What names were held against.
    """
    judgment, checks, members = _settle_best_set(judgment, checks)
    case, search, decision = null.case, judgment.search, judgment.decision
    effects, best = case.effects, null.fit
    if search is not None and members:
        best = search.fit_of(members)
    if members and not best.converged:
        why = f"of the extended model: its sizes are not to be trusted ({best.message})"
        checks = checks.joined([GateResult("fit_converged", False, 0.0, 1.0, why)])
    about = None if search is None else averaged(search, judgment, best, checks.changes)
    (base, bent), chosen_by = _base(best, judgment), "" if validation is None else validation.words
    grounds = None
    if about is not None:
        grounds = Grounds(judgment, about, members, best, checks.gates, base, chosen_by)
    known = _evidence(judgment, grounds, screened, effects, members, case.unmet)
    rivals, causes = known.rivals, cause_rows(known, base)
    refused = grounds is not None and bool(grounds.refused)
    is_off = any(row.finding for row in base)
    verdict, named = _verdict(judgment, known.alone, is_off=is_off, stands_in=refused)
    if verdict == "named" and named <= known.undone:
        verdict, named = "ambiguous", decision.best
    if verdict == "unknown" and not any(gate.name == REPEATED for gate in checks.gates):
        checks = checks.joined(repeated_gate(best, seed))
    # of a verdict that names what all sets share, the sets are all given
    sets = (Hypothesis(decision.best), *rivals) if verdict == "named" and rivals else rivals
    rows = effect_rows(effects, judgment, screened, checks.changes, best)
    own_factors = [  # of the causes that have a status of their own
        row.factor
        for row in causes
        if row.status in (CERTAIN, LIKELY) or (row.probability is not None and row.rivals)
    ]
    beside = None if decision.beside is None else decision.beside.unknown
    is_little_left = best.chi2 <= MUCH_LEFT**2 * best.num_samples
    case.progress("judged", 1.0, verdict.replace("_", " "))
    return Report(
        verdict=verdict,
        decision=decision,
        causes=causes,
        rivals=tuple(set_names(h, effects, case.unknowns) for h in sets),
        gates=checks.gates,
        floor=null.noise,
        named=set_names(Hypothesis(named), effects, ()),
        best_names=set_names(Hypothesis(decision.best), effects, ()),
        beside="" if beside is None or search is None else search.unknowns[beside].name,
        bent=bent,
        away=told_away(base, case.model.base) if is_little_left else (),
        plain_twin=_plain_twin(null.fit, best) if members else (),
        drives=case.model.drives,
        is_full=case.settings.plain_steps > FIRST_STEPS,
        left=float(np.sqrt(best.chi2 / best.num_samples)),
        with_unknown=_with_unknown(search, members, best.num_samples),
        chosen_by=chosen_by,
        hypotheses=hypothesis_rows(search, effects, case.unknowns, decision.instead),
        table=rows,
        screened=screened,
        cannot_see=cannot_see(effects, screened, case.unmet, rows),
        num_spikes=null.num_spikes,
        num_misread=null.num_misread,
        gain=judgment.gain,
        settings=_settings(null, search, seed),
        null=null.fit,
        best=best,
        apart=apart_in_fit(best, ranges_of_answer(best, base, causes)),
        study=case.study,
        model=case.model,
        next_run=_advice(judgment, best, bank),
        force_map=None if search is None else _force_map(search),
        base=base,
        unknown_share=_unknown_share(null, best, judgment),
        interval_factor=max(own_factors, default=1.0 if about is None else about.usual),
        band=band_of(
            best,
            case.study.channels,
            null.noise.sd,
            case.study.select_runs,
            validation,
            null.fit,
        ),
    )


def _evidence(
    judgment: Judgment,
    grounds: Grounds | None,
    screened: Screen,
    effects: Sequence[Effect],
    members: Members,
    unmet: Mapping[str, str],
) -> CauseEvidence:
    """What the rows of causes are made from; where nothing was searched, no precondition is
    asked."""
    decision = judgment.decision
    known = CauseEvidence(judgment, None, screened, effects, members, unmet)
    if grounds is None:
        return replace(known, rivals=decision.rivals)
    left = float(np.sqrt(grounds.fit.chi2 / grounds.fit.num_samples))
    alone, asked = singled_out(grounds), decision.best if decision.verdict in NAMES else NONE
    doubts = {i: doubts_of(grounds, i) for i in asked}
    return replace(
        known,
        about=grounds.about,
        undone=frozenset(i for i in asked if OTHERS_UNDO_IT in doubts[i]),
        alone=alone,
        rivals=open_rivals(decision, grounds.about, alone),
        doubts=doubts,
        doubts_of_names=doubts_of_names(grounds),
        doubts_of_fit=doubts_of_fit(grounds),
        wrong_gradients=wrong_gradients(grounds.gates),
        left=left if left > MUCH_LEFT else 1.0,
    )


def _settle_best_set(judgment: Judgment, checks: Checks) -> tuple[Judgment, Checks, frozenset[int]]:
    """The judgment with what may stand in place of its causes, the checks at its best set, and the
    effects that the extended model holds."""
    search, best = judgment.search, judgment.decision.best
    if search is None:
        return judgment, checks, NONE
    if best:
        search = with_numerics(search, best)
        checks = checks.at_set(search.numerics.get(best))
        judgment = _with_forms(judgment, search, checks.unrefined)
    decision = judgment.decision
    members = judgment.helps | (decision.best if decision.verdict in NAMES else NONE)
    search = with_numerics(judgment.search or search, members)
    judgment = replace(judgment, search=search)
    return judgment, checks.at_set(search.numerics.get(members)), members


def tested(frozen: Report, study: Study, seed: int, laws: Collection[str] = ()) -> Report:
    """The frozen answer with its errors on test runs, and in words.

    What test runs show can take a verdict back, and make of certain causes likely ones; it adds
    nothing. ``before_test`` holds what the answer was. Without test runs errors are those of select
    runs, and no gain is known.

    Args:
        frozen: Report whose answer does not change any more but by what is taken back.
        laws: Names of the causes that no library holds.
    """
    seen, is_test = frozen.study, bool(study.test_runs)
    unmet = unmet_by(frozen.best.problem)
    banded: dict[str, Any] = {}
    if frozen.band is not None:
        half_widths = partial(
            frozen.band.half_widths,
            frozen.best,
            np.sqrt(np.diag(frozen.best.covariance)),
            channels=seen.channels,
            unmet=unmet,
        )
        banded = {"half_widths": half_widths}
    found = on_unseen(
        frozen.null,
        frozen.best,
        study.test_runs or seen.select_runs,
        seen.channels,
        frozen.floor.sd,
        spans_of(seen.fit_runs, seen.channels, seen.commands),
        seed=seed,
        use="test" if is_test else "select",
        commands=seen.commands,
        unmet=unmet,
        **banded,
        constants=constants_of(seen.fit_runs, seen.channels),
    )
    gain = found.gain if frozen.best.problem.effects else None
    gained = gain if is_test else None  # runs that chose between causes prove none
    answer = taken_back(frozen, gained, found.errors)
    named = [row for row in answer.causes if row.status in (CERTAIN, LIKELY)]
    is_late = any(row.origin == EFFECT and row.unit == "s" for row in named)
    return replace(
        answer,
        study=replace(study, runs=(*seen.runs, *study.test_runs)),
        errors=found.errors,
        outside=found.outside,
        own=found.own,
        bands=found.bands,
        gain=gained,
        headline=headline(answer, found.errors, found.failed, gain, laws),
        sentences=(
            *sentences(answer, gained, found.errors, found.failed),
            *own_words(found.own),
            *([resolution_words(study)] if is_late else []),
        ),
    )


def doubted(frozen: Report, doubt: str) -> Report:
    """The frozen answer, none of its effects being certain.

    Args:
        frozen: Report before test runs were looked at.
        doubt: Why they are not.
    """
    causes = [
        _after_test(row, (doubt,), is_withdrawn=False) if row.status == CERTAIN else row
        for row in frozen.causes
    ]
    return replace(frozen, causes=ranked(causes))


def taken_back(frozen: Report, gained: Gain | None, errors: Sequence[ErrorRow]) -> Report:
    """The answer without what the test runs took from it.

    Args:
        frozen: Report before they were looked at.
        gained: Gain on test runs; None without such runs or without a cause.
        errors: Errors on runs that were not fitted.
    """
    if frozen.verdict == "none":
        off = [(row.run, row.after / row.noise) for row in errors if row.noise > 0.0]
        against = contradiction_gate(dict(sorted(off, key=lambda pair: pair[1])))
        verdict = "unknown" if against else "none"
        return replace(frozen, verdict=verdict, gates=(*frozen.gates, *against))
    # far from the noise, an error that names do not lower speaks against them, sure to rise or not
    is_withdrawn = gained is not None and (
        gained.status == "withdrawn" or (gained.value < 0.0 and gained.left > MUCH_UNSEEN**2)
    )
    is_withdrawn = is_withdrawn and frozen.verdict in NAMES
    doubts = tuple(doubts_of_unseen(gained, errors))
    causes = [_after_test(row, doubts, is_withdrawn=is_withdrawn) for row in frozen.causes]
    before = {
        row.name: row.status
        for row, now in zip(frozen.causes, causes, strict=True)
        if row.status != now.status
    }
    if not (before or is_withdrawn):
        return replace(frozen, causes=tuple(causes))
    answer = replace(frozen, causes=ranked(causes), before_test=BeforeTest(frozen.verdict, before))
    return replace(answer, verdict="unknown", named=()) if is_withdrawn else answer


def _after_test(row: CauseRow, doubts: tuple[str, ...], *, is_withdrawn: bool) -> CauseRow:
    """The row of an effect, which test runs may have withdrawn or left likely at most."""
    if row.origin != EFFECT:
        return row
    if is_withdrawn and row.status in (CERTAIN, LIKELY):
        return replace(row, status=UNTOLD, rivals=(REST,), doubts=())
    if row.status == CERTAIN and doubts:
        return replace(row, status=LIKELY, doubts=doubts)
    return replace(row, doubts=(*row.doubts, *doubts)) if row.status == LIKELY else row


def _base(best: Fit, judgment: Judgment) -> tuple[tuple[BaseRow, ...], tuple[BaseRow, ...]]:
    """Base parameters, and those that are no finding, as what the fit leaves may have bent them."""
    judged = judgment.decision.verdict not in ("unrepeatable", "numerical")
    wrong, about = judgment.decision.data_sheets, widening(best)
    rows = base_rows(best, best.problem.runs, about, judged=judged, wrong=wrong)
    found = tuple(row for row in rows if row.finding)
    if not found or best.chi2 <= MUCH_LEFT**2 * best.num_samples:
        return rows, ()
    return base_rows(best, best.problem.runs, about, judged=False, wrong=wrong), found


def _plain_twin(plain: Fit, best: Fit) -> tuple[BaseRow, ...]:
    """Base parameters by which the plain model explains the fitted runs as well as the best set:
    those off their data sheets, and those that are off by the same factor."""
    if misfit_unheld(plain) > best.chi2 + 2.0 * KEEP_NATS:
        return ()
    rows = base_rows(plain, plain.problem.runs, widening(plain), judged=True)
    off = [row for row in rows if row.finding]
    factors = [row.value / row.prior_value for row in off if row.prior_value]
    alike = [
        row
        for row in rows
        if row.run is None and not row.finding and row.prior_value
        if any(is_same_factor(row.value / row.prior_value, of) for of in factors)
    ]
    return (*off, *alike)


def _verdict(
    judgment: Judgment, alone: frozenset[int], *, is_off: bool, stands_in: bool
) -> tuple[str, frozenset[int]]:
    """Verdict of the causes that are singled out, and the effects that it names.

    Where rivals share causes that are, these are named: only the rest cannot be told. Where
    none is and an unknown cause has the evidence beside the best set, or the set may stand in for
    what unseen runs refused, something unknown is the verdict. A best set of which nothing is
    singled out, and that leaves much, is not named either. What a data sheet has wrong is no noise,
    and no cause that the model lacks: a verdict of its own.
    """
    decision = judgment.decision
    if decision.verdict == "named" and not alone:
        if decision.beside is not None or stands_in:
            return "unknown", NONE
        if decision.share < EXPLAINED:
            return "ambiguous", decision.best
    if decision.verdict == "ambiguous":
        return ("named", alone) if alone else ("ambiguous", decision.best)
    if decision.verdict == "none" and is_off:
        return "data_sheet", NONE
    return decision.verdict, decision.best if decision.verdict == "named" else NONE


def _with_forms(judgment: Judgment, search: Search, unrefined: Mapping[str, Array]) -> Judgment:
    """The judgment, what may be another cause's form left open; the set without it is fitted."""
    best = judgment.decision.best
    stepped = own_steps(search, best) if search.null.case.correction is not None else {}
    decision = without_forms(
        judgment.decision, search.fit_of(best), unrefined, stepped, search.fits
    )
    decision = without_wrong_data_sheets(decision, search)
    if decision.forms:  # of several forms, the search need not have come by
        search = refit(search, decision.best - set(decision.forms))
    return replace(judgment, decision=decision, search=search)


def _advice(judgment: Judgment, best: Fit, bank: Sequence[Run]) -> Any:
    """The run of a bank that separates rivals best; None where there are none."""
    search, fits = judgment.search, [best]
    if search is not None:
        rivals = [h for h in judgment.decision.rivals if h.unknown is None]
        fits += [search.fit_of(h.effects) for h in rivals if h in search.posteriors]
    if not bank or len(fits) < 2:
        return None
    try:
        return next_run(fits, bank)
    except DiffsimError:  # no run of the bank can be simulated with these sets: the answer stands
        return None


def _with_unknown(search: Search | None, members: frozenset[int], count: int) -> dict[str, float]:
    """What the unknown cause with the best evidence beside a set, or a part of it, would leave, by
    its name [noise sd]; empty where none was weighed."""
    if search is None:
        return {}
    weighed = [h for h in search.posteriors if h.unknown is not None and h.effects <= members]
    if not weighed:
        return {}
    best = max(weighed, key=search.nats)
    assert best.unknown is not None
    chi2 = search.posteriors[best].chi2
    return {search.unknowns[best.unknown].name: float(np.sqrt(max(chi2, 0.0) / count))}


def _unknown_share(null: Null, best: Fit, judgment: Judgment) -> float | None:
    """Share of the misfit above the noise that is left; None where nothing was searched."""
    if judgment.search is None:
        return None
    missing = null.fit.chi2 - null.fit.num_samples
    if missing <= 0.0 or judgment.decision.verdict == "none":
        return 0.0
    return float(np.clip((best.chi2 - best.num_samples) / missing, 0.0, 1.0))


def _settings(null: Null, search: Search | None, seed: int) -> dict[str, Any]:
    """Thresholds, seed, effort, versions."""
    case = null.case
    return {
        "seed": seed,
        "keep_nats": KEEP_NATS,
        "alone_nats": ALONE_NATS,
        "explained": EXPLAINED,
        "unrepeatable": UNREPEATABLE,
        "work": case.model.simulations.since(case.begun)._asdict(),
        "search": asdict(case.settings.search),
        "numerics": None if (made := null.fit.problem.reference_numerics) is None else asdict(made),
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

    posteriors: Mapping[Hypothesis, Any] = search.posteriors
    return {
        "could_not_be_simulated": [name(h) for h in search.failed],
        "not_converged": [name(h) for h, w in posteriors.items() if w.fit and not w.fit.converged],
        "slopes_borrowed_at": [name(Hypothesis(m)) for m in search.borrowed],
    }


def _force_map(search: Search) -> ForceMap | None:
    """Map of the first unknown force, at the plain model; its slopes were simulated for the
    search."""
    for u, cause in enumerate(search.unknowns):
        slopes = search.simulations.unknown_slopes.get((NONE, u))
        if isinstance(cause, UnknownForce) and slopes is not None:
            return force_map(search.wide, cause, slopes.array(), search.plain.evidence.residual)
    return None
