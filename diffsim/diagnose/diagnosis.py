"""From a study and a simulator to one verdict with its evidence."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import partial
from hashlib import blake2b
from pathlib import Path

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.core.errors import DiffsimError
from diffsim.core.threads import one_thread
from diffsim.data.study import Run, Study
from diffsim.diagnose.checks.gates import (
    CONTRADICTED,
    LEAST_FREEDOM,
    GateResult,
    budget_gates,
    cuts_gate,
    data_gate,
    few_samples_gate,
    law_gate,
    leaves_more,
    repeatability_gate,
    unsimulable_gate,
    windows_gate,
)
from diffsim.diagnose.checks.gradients import GRADIENT_SHARE, gradient_gate
from diffsim.diagnose.checks.noise import noise_floor
from diffsim.diagnose.checks.numerics import (
    NUMERICS_LAMBDA,
    OF_NAMES,
    SetNumerics,
    check_numerics_of_set,
    could_be_misfit,
    numerical_effects,
    refine_within,
)
from diffsim.diagnose.discover.answer import in_words, with_laws_said
from diffsim.diagnose.discover.stage import Begin, FoundLaws, at_data_sheet, find_laws
from diffsim.diagnose.inputs import Inputs
from diffsim.diagnose.judge.band import BELOW_NOISE
from diffsim.diagnose.judge.gain import Validation, validation_of
from diffsim.diagnose.judge.judge import NAMES, Decision, Judgment, decision_of, judge
from diffsim.diagnose.judge.preconditions import ENDED
from diffsim.diagnose.say.assemble import Checks, doubted, report_of, tested
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.tables import FIRST_LOOK, first_look
from diffsim.diagnose.search.coarse import (
    SLOWEST,
    CorrectionAt,
    carried,
    coarse_gate,
    corrected,
    corrected_at,
    renewed_at,
)
from diffsim.diagnose.search.evidence import ALONE_NATS, Hypothesis, screen
from diffsim.diagnose.search.fit import (
    MAX_RENEWALS,
    Case,
    Null,
    Progress,
    RefinedNull,
    check_numerics,
    coarsen_first_look,
    null_fit,
    refit_under,
    silent,
)
from diffsim.diagnose.search.fitted_sets import Search
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.search import (
    begin,
    begin_from,
    fitted_to_end,
    refit,
    search_sets,
    weigh_unknowns_beside,
    with_numerics,
)
from diffsim.diagnose.search.simulations import NONE, Members, Simulations
from diffsim.diagnose.search.store import Store, key_of
from diffsim.identify import Fit
from diffsim.identify.effect import Effect
from diffsim.identify.effort import KEEP_NATS, DiagnosisSettings
from diffsim.identify.linearization import linearization_at, residuals_by_run
from diffsim.identify.model import SimModel
from diffsim.identify.problem import PredictionError, Problem
from diffsim.identify.setup import LawPort
from diffsim.identify.unknown import Unknown, drifts

FIRST_SHARE = 0.4  # of the gradient checks' work, where simulations are expensive
ROOM_SHARE = 0.5  # of a budget that causes of the library may spend before laws are short of it
ROOM_RECORDS = 960.0  # simulations that what is kept for laws must allow: a beam's took 170 CPU s
LEAST_ROOM = 0.2  # of it, without which laws are not looked for
MAX_AT_SETS = 6  # corrections at sets: each leaves at most 0.7 of the one before, mostly a third
AS_GOOD = "a law that nobody listed explains as much"
Begins = Sequence[Begin]
Ends = Sequence[tuple[Members, Array]]  # sets with their ends, standardized coordinates
NOISE_CHANGED = 0.03  # relative; a larger change of the floor asks for another round


@checked
@one_thread
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
    laws: LawPort | None = None,
) -> Report:
    """Find what the simulator gets wrong.

    Args:
        study: Recorded runs; those with use: test are looked at once, at the end.
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
        laws: Where laws that no library holds may enter; None: they are not looked for.

    Returns:
        The verdict with its evidence.

    Raises:
        ValueError: the study cannot be judged at all, or effects share a name.
    """
    asked = _Question(study, bank, settings, progress, cache, seed, laws is not None)
    begun = model.simulations.steps
    answer = _answer(asked, model, effects, unknowns)
    found = None
    if laws is not None and answer.lacks_something:
        budget = _budget_of_laws(answer, begun)
        plain = answer.search.null.fit
        freedom = plain.num_samples - len(plain.problem.names)
        if freedom < LEAST_FREEDOM:
            gates = (*answer.frozen.gates, few_samples_gate(freedom))
            answer = replace(answer, frozen=replace(answer.frozen, gates=gates))
        elif budget.steps == 0.0:
            answer = _without_laws(answer)
        else:
            fits = [answer.search.fit_of(members) for members in dict.fromkeys((NONE, answer.best))]
            fits = [*at_data_sheet(plain), *fits]
            library = answer.search.wide.effects
            found = find_laws(fits, laws, progress or silent, budget.steps, library)
            first = answer
            answer, again = _with_laws(asked, first, laws, found, budget)
            is_late = budget.until is not None and model.simulations.steps > budget.until
            if not is_late and (beside := _newly_named(first, again, found)):
                beside_causes = find_laws(beside, laws, progress or silent, budget.steps, library)
                last, _ = _with_laws(asked, first, laws, beside_causes, budget)
                if _is_better(last, answer, beside_causes):
                    answer, found = last, beside_causes
    frozen = answer.frozen
    # only now test runs are looked at, once
    if found is None:
        return tested(frozen, study, seed)
    names = {law.name for law in found.laws}
    return with_laws_said(tested(in_words(frozen, found), study, seed, names), found)


def diagnosed(
    inputs: Inputs, *, progress: Progress | None = None, cache: str | Path | None = None
) -> Report:
    """The answer to all inputs of a diagnosis: what ``diffsim diagnose explain`` says.

    Args:
        inputs: Study, setup and seed.
        cache: Folder for what was simulated, as of ``diagnose``.
    """
    setup = inputs.setup
    return diagnose(
        inputs.study,
        setup.model,
        setup.effects,
        seed=inputs.seed,
        unknowns=setup.unknowns,
        bank=setup.bank,
        settings=setup.settings,
        progress=progress,
        cache=cache,
        laws=setup.laws,
    )


@dataclass(frozen=True, eq=False)
class _Question:
    """What a diagnosis is asked for, whatever causes are weighed."""

    study: Study
    bank: Sequence[Run]
    settings: DiagnosisSettings | None
    progress: Progress | None
    cache: str | Path | None
    seed: int
    keeps_room: bool = False

    def within(self, steps: float) -> _Question:
        """The same with a smaller budget."""
        settings = self.settings or DiagnosisSettings()
        search = replace(settings.search, refit_steps=steps, scan_steps=steps)
        return replace(self, settings=replace(settings, search=search), keeps_room=False)

    def with_room(self, null: Null) -> tuple[Case, float]:
        """The case with the budget that its search may spend, and what that leaves for laws: none
        where they have one of their own."""
        case, settings = null.case, null.case.settings
        own = settings.search
        if own.law_steps is not None:
            return case, 0.0
        spent = ROOM_SHARE * own.refit_steps
        search = replace(own, refit_steps=spent, scan_steps=min(own.scan_steps, spent))
        settings = replace(settings, search=search)
        return replace(case, settings=settings), own.refit_steps - spent


@dataclass(frozen=True, eq=False)
class _Answer:
    """An answer before test runs.

    Attributes:
        search: Behind it; None where nothing was searched.
        best: Set of causes with the best evidence.
        kept: Weighted steps of the budget that it left for laws.
    """

    frozen: Report
    found: Search | None = None
    best: Members = NONE
    kept: float = 0.0

    @property
    def search(self) -> Search:
        """What was searched."""
        assert self.found is not None
        return self.found

    @property
    def lacks_something(self) -> bool:
        """Whether something is missing, whatever its name may be. What is named and leaves far less
        than the noise is all that may be asked: a law would tell what the study says to be
        noise."""
        if self.found is None or self.frozen.verdict not in (*NAMES, "unknown"):
            return False
        if any(gate.name == CONTRADICTED for gate in self.frozen.gates):
            # where fitted runs leave noise no law can be told from them; one that the other fitted
            # runs contradict may show a law that acts in it alone, such as a stop
            return leaves_more(self.search.fit_of(NONE))
        return self.frozen.verdict == "unknown" or self.frozen.left > BELOW_NOISE

    def nats_with(self, laws: AbstractSet[str]) -> tuple[float, float]:
        """Evidence of the best set without a law, and with one."""
        effects, most = self.search.wide.effects, [-np.inf, -np.inf]
        for members in self.search.fits:
            has_law = any(effects[i].name in laws for i in members)
            most[has_law] = max(most[has_law], self.search.nats(Hypothesis(members)))
        return most[0], most[1]


@dataclass(frozen=True)
class _LawBudget:
    """What laws may cost."""

    steps: float  # weighted steps of the stage that finds them; 0: they are not looked for
    # count of weighted steps at which the search with laws ends; None: it has ``steps``, too
    until: float | None
    # whether the first answer has spent much of the budget: then the search with laws is among
    # causes of its best sets and those that act where laws do
    is_short: bool


def _budget_of_laws(answer: _Answer, begun: int) -> _LawBudget:
    """What laws may cost: a budget of their own, or what causes of the library have left of theirs.

    Args:
        begun: Weighted steps that were simulated before it.
    """
    spent, settings = answer.search.steps - begun, answer.search.settings
    given = settings.refit_steps + answer.kept
    is_enough = answer.kept >= ROOM_RECORDS * answer.search.wide.cost()
    room = max(given - spent, answer.kept if is_enough else 0.0)  # what is kept for laws is theirs
    is_short = room < ROOM_SHARE * given
    if settings.law_steps is not None:
        return _LawBudget(settings.law_steps, None, is_short)
    until, is_over = answer.search.steps + room, room < LEAST_ROOM * given
    return _LawBudget(0.0 if is_over else ROOM_SHARE * room, until, is_short)


def _without_laws(answer: _Answer, *, are_found: bool = False) -> _Answer:
    """The answer of a budget that ended before laws were looked for, or before those that were
    found could be weighed: none of it is certain."""
    frozen = doubted(answer.frozen, ENDED[answer.frozen.is_full])
    late = law_gate(answer.search.settings.refit_steps + answer.kept, are_found=are_found)
    return replace(answer, frozen=replace(frozen, gates=(*frozen.gates, late)))


def _with_laws(
    asked: _Question, answer: _Answer, port: LawPort, found: FoundLaws, budget: _LawBudget
) -> tuple[_Answer, _Answer | None]:
    """The answer of a search in which laws stand among the causes, if one of them is named; and
    what that search says in any case, None where it could not be made."""
    answer = _doubted_beside(answer, answer.search.nats(Hypothesis(answer.best)), found.most_nats)
    if not found.laws:
        return answer, None
    is_spent = budget.until is not None and answer.search.steps > budget.until
    if is_spent and answer.frozen.verdict in NAMES:  # of "unknown" a law is all that can be told
        return _without_laws(answer, are_found=True), None
    setup = port.setup_with([port.block(law) for law in found.laws])
    setup.model.simulations = answer.search.wide.model.simulations  # goes on counting
    names = {law.name for law in found.laws}
    effects = setup.effects
    if budget.until is not None:
        asked = asked.within(max(budget.until - answer.search.steps, 1.0))
    elif budget.is_short:
        asked = asked.within(budget.steps)
    if budget.is_short:
        entries = [law.entry for law in found.laws]
        targets = {part.target for entry in entries for part in entry.parts or (entry,)}
        kept = names | found.beside | _names_near_best(answer, targets)
        effects = tuple(e for e in effects if e.name in kept)
    try:
        again = _answer(asked, setup.model, effects, setup.unknowns, found.begins)
    except PredictionError as error:  # such as an exponential of what goes far: the answer stands
        gates = (*answer.frozen.gates, unsimulable_gate(error))
        return replace(answer, frozen=replace(answer.frozen, gates=gates)), None
    frozen = again.frozen
    named = frozen.best_names if frozen.verdict in NAMES else ()
    held = named or [effect.name for effect in frozen.best.problem.effects]
    if again.found is None:
        return answer, again
    nats, of_law = again.nats_with(names)
    before, now = (one.search.null.noise.whitener for one in (answer, again))
    if now.is_like(before):  # that search may not have come to the best set without laws
        first = answer.search.nats(Hypothesis(answer.best))
        # or, where it began at a law, to a far better one
        if not names & set(held) and frozen.verdict in NAMES and nats > first + KEEP_NATS:
            return again, again
        nats = max(nats, first)
    is_ahead = of_law > nats
    if is_ahead and names & set(held) and _may_take_over(frozen, answer.frozen, names):
        return again, again
    return _doubted_beside(answer, nats, of_law), again


def _newly_named(first: _Answer, again: _Answer | None, found: FoundLaws) -> list[Fit]:
    """The causes that a search names beside laws, fitted without these; empty where there are none,
    or laws were looked for beside them before. While they were missing they have bent the laws.
    """
    if again is None or again.frozen.verdict not in NAMES:
        return []
    laws, named = {law.name for law in found.laws}, set(again.frozen.best_names)
    effects = first.search.wide.effects
    members = frozenset(i for i, e in enumerate(effects) if e.name in named - laws)
    if not laws & named or members in (NONE, first.best) or named - laws <= found.beside:
        return []
    search = refit(first.search, members)
    return [search.fit_of(members)] if members in search.fits else []


def _is_better(answer: _Answer, before: _Answer, found: FoundLaws) -> bool:
    """Whether an answer with laws may stand for one before it."""
    laws = {law.name for law in found.laws} & set(answer.frozen.best_names)
    return bool(laws) and _may_take_over(answer.frozen, before.frozen, laws)


def _doubted_beside(answer: _Answer, nats: float, of_law: float) -> _Answer:
    """The answer, none of its causes being certain where a law has evidence within the odds.

    A law pays for the choice among all that was tried: one that says the same as a cause of the
    library is behind it.
    """
    is_clear = nats - of_law >= ALONE_NATS
    return answer if is_clear else replace(answer, frozen=doubted(answer.frozen, AS_GOOD))


def _may_take_over(again: Report, before: Report, laws: AbstractSet[str]) -> bool:
    """Whether an answer with a law may stand for one without.

    Each law must lower the error of unseen runs for sure, over the same set without it: a law is
    chosen among hundreds, by the runs that it is fitted to. Where both answers name something, one
    search has weighed causes and laws: no set without a law may be within the odds there, and
    unseen runs must not prefer what was named before. Else the new one gains more for sure.
    """
    names_something = again.verdict in NAMES
    if not names_something and before.verdict in NAMES:
        return False
    if again.gain is None:  # nothing is unseen: the evidence alone decides
        return names_something and before.gain is None
    own = {row.name: row.gain for row in again.causes if row.name in laws & set(again.best_names)}
    if names_something and not all(g is not None and g.has_fallen for g in own.values()):
        return False
    if names_something and before.verdict not in NAMES:
        return True
    if before.gain is None or again.gain.low > before.gain.value:
        return True
    is_alone = names_something and all(laws & set(rival) for rival in again.rivals)
    return is_alone and again.gain.value >= before.gain.value


def _names_near_best(answer: _Answer, targets: AbstractSet[str] = frozenset()) -> set[str]:
    """Names of the causes of sets that are about as good as the best one, and of all causes where
    laws enter: beside a law elsewhere one of these may do what a law was found for.
    """
    search = answer.search
    nats = {members: search.nats(Hypothesis(members)) for members in search.fits}
    least = nats[answer.best] - search.settings.rival_nats
    near = {search.wide.effects[i].name for m, n in nats.items() if n >= least for i in m}
    ends = tuple(f"_at_{target}" for target in targets)
    return near | {e.name for e in search.wide.effects if e.name.endswith(ends)}


def _answer(
    asked: _Question,
    model: SimModel,
    effects: Sequence[Effect],
    unknowns: Sequence[Unknown],
    first: Begins = (),
) -> _Answer:
    """Search among causes, and judge; no test run is looked at.

    Args:
        model, effects, unknowns: As of ``diagnose``.
        first: Sets and their coordinates, at which the search begins; none: at the plain model.
    """
    study, seed, bank, cache = asked.study, asked.seed, asked.bank, asked.cache
    gates = (*data_gate(study), *cuts_gate(model))
    # from here to the end of the search nothing can look at a test run: there is none
    known = study.without_tests()
    case = _make_case(known, model, effects, unknowns, asked.settings, asked.progress)
    case = replace(case, num_tests=len(study.test_runs))
    case.progress("null fit", 0.0, "the model without effects")
    case, once = coarsen_first_look(case)
    null = null_fit(case)
    null.case.progress("checks", 0.15, "numerical settings")
    null, checks, simulations = _check_null(null, gates, cache, once)
    at = checks.center.evidence
    screened = screen(at)
    # where nothing is left, refined settings leave more: they are no part of a misfit
    is_coarse = leaves_more(null.fit) and could_be_misfit(null.fit, checks.gates)
    if is_coarse and not null.case.settings.accept_numerics:
        decision = Decision("numerical", frozenset(), (), None, 0.0)
        return _Answer(report_of(null, checks, Judgment(decision), screened, seed, bank))
    seen = first_look(screened, at.problem.effects, null.fit.chi2)
    null.case.progress(FIRST_LOOK, 0.27, seen)
    kept = 0.0
    if asked.keeps_room:
        case, kept = asked.with_room(null)
        null = replace(null, case=case)
    null = replace(null, case=replace(null.case, searching=model.simulations.steps))
    search, renewal = _renew_correction(search_rounds(null, simulations, first))
    checks, null = checks.joined(renewal), search.null
    screened = screen(search.plain.evidence)
    case.progress("gain", 0.88, "unseen runs")
    select = search.null.case.study.select_runs
    validation = validation_of(search.fit_of(NONE), select, case.settings.plain_steps)
    num_unscanned = len(search.simulations.scans_late)
    plain = search.null.fit
    late = tuple(budget_gates(num_unscanned, search.num_late, search.settings, plain))
    checks, judgment = _judge_search(search, checks.joined(late), validation, seed)
    frozen = report_of(search.null, checks, judgment, screened, seed, bank, validation)
    return _Answer(frozen, judgment.search or search, judgment.decision.best, kept)


def search_rounds(
    null: Null, simulations: Simulations, first: Begins = (), again: Sequence[Members] = ()
) -> Search:
    """Search; estimate the noise from what the best set leaves; again if it has changed, from what
    was simulated before: where that is coarse and corrected, at the sets that were found.

    Args:
        simulations: Simulations made so far.
        first: Sets and their coordinates, at which the search begins; none: at the plain model.
        again: Sets that an earlier search found, at whose ends it begins.
    """
    case = null.case
    known = [_set_at(null.wide, begin_at) for begin_at in first]
    for round_ in range(case.settings.noise_rounds):
        search = _search_fine_enough(null, simulations, known, again)
        null, simulations = search.null, search.simulations
        best = simulations.fitted[decision_of(search).best]
        residuals = residuals_by_run(case.study.fit_runs, best.record)
        after = noise_floor(case.study.fit_runs, case.study.channels, residuals, explained=True)
        is_same = after.source == null.noise.source and bool(
            (np.abs(after.sd / null.noise.sd - 1.0) < NOISE_CHANGED).all()
        )
        if is_same or round_ == case.settings.noise_rounds - 1:
            break
        null = null.under(after)
        again = _best_sets(search) if null.case.correction is not None else ()
    # the report shows the floor that the best set leaves
    return replace(search, null=replace(null, noise=after))


def _renew_correction(search: Search) -> tuple[Search, tuple[GateResult, ...]]:
    """The search under a correction that holds at its answer, where coarse simulations have one;
    with finer settings from there, where it was made at a set and none holds.

    Returns:
        The search, and what coarse simulations have wrong at the answer.
    """
    if search.null.case.beyond is not None:
        return _renew_at_sets(search)
    size = 0.0
    for round_ in range(MAX_RENEWALS):
        null, fit = search.null, search.fit_of(decision_of(search).best)
        if fit.problem.correction is None:
            return search, ()
        null.case.progress("search", 0.84, "finer simulations of the answer")
        try:
            new, size = renewed_at(fit)
        except DiffsimError:  # finer simulations fail at the answer, which stays as it is
            size = math.inf
            break
        if size < NUMERICS_LAMBDA or round_ == MAX_RENEWALS - 1:
            break
        again = _best_sets(search)
        null, made = _under(replace(null.case, correction=new), search, "renewed")
        search = search_rounds(null, made, again=again)
    search = weigh_unknowns_beside(search, decision_of(search).best)
    return search, (coarse_gate(size, search.null.fit.problem),)


def _renew_at_sets(search: Search) -> tuple[Search, tuple[GateResult, ...]]:
    """The same where a correction was made at a set, until one holds at the best one."""
    size, best = math.inf, NONE
    for round_ in range(MAX_AT_SETS):
        null, last, before = search.null, best, size
        best = decision_of(search).best
        null.case.progress("search", 0.84, "finer simulations of the answer")
        fit, at = search.fit_of(best), search.simulations.fitted[best]
        try:
            found, size = corrected_at(fit, at, null.case.settings)
        except DiffsimError:  # what is found by coarse simulations is likely at most
            size = math.inf
            search = replace(search, null=replace(null, case=replace(null.case, beyond=None)))
            break
        case = _with_correction(null.case, found)
        if size < NUMERICS_LAMBDA:  # of what is left to refine there the gates tell
            kept = replace(null.case, beyond=case.beyond)
            search = replace(search, null=replace(null, case=kept))
            break
        is_slow = best == last and size > SLOWEST * before  # that of another set is another one
        if round_ and search.steps > null.case.searching + search.settings.refit_steps:
            search = replace(search, null=replace(null, case=replace(null.case, beyond=None)))
            break  # as far as the budget goes; what it names is likely at most
        if is_slow or round_ == MAX_AT_SETS - 1:
            return _search_finely(search), ()  # friction may stick by coarse steps alone
        again = _best_sets(search)
        search = search_rounds(*_under(case, search, "renewed"), again=again)
    search = weigh_unknowns_beside(search, decision_of(search).best)
    return search, (coarse_gate(size, search.null.fit.problem, is_at_set=True),)


def _with_correction(case: Case, found: CorrectionAt) -> Case:
    """A case with the correction that was found at a set."""
    gates = tuple(replace(g, note=g.note + OF_NAMES) for g in found.gates)
    beyond = SetNumerics(found.changes, gates)
    return replace(case, correction=found.correction, beyond=beyond)


def _search_finely(search: Search) -> Search:
    """The search from what it found, everything simulated with settings that suit that, as far as
    the budget allows."""
    null, fit = search.null, search.fit_of(decision_of(search).best)
    case = replace(null.case, correction=None, beyond=None)
    plain = replace(fit, problem=replace(fit.problem, correction=None))
    budget, once = case.settings.refine_budget, replace(plain.problem, numerics=None).cost()
    checked = check_numerics_of_set(plain, plain.problem.record(fit.x), case.settings)
    numerics, *_ = refine_within(plain, budget, checked.changes, checked.gates, once)
    case.progress("search", 0.3, "finer numerical settings, which the best set needs")
    found = [(members, search.fit_of(members).x) for members in _best_sets(search)]
    null = _store_anew(refit_under(replace(null, case=case), numerics))
    return _search_from(null, Simulations(null.wide, null.case.store).under(null), found)


def _best_sets(search: Search) -> list[Members]:
    """The best set, and beside it the best ones without one of its members: coarse steps may have
    put one that does the same behind."""
    best = decision_of(search).best
    fits = sorted(search.fits, key=lambda s: -search.nats(Hypothesis(s)))
    least = [next(s for s in fits if i not in s) for i in sorted(best)]
    return [s for s in dict.fromkeys([best, *least]) if s != NONE]


def _search_fine_enough(
    null: Null, simulations: Simulations, first: Ends = (), again: Sequence[Members] = ()
) -> Search:
    """Search; where numerical settings are too coarse for the best set, finer simulations at its
    fit correct all others, and the search goes on."""
    search = _search_from(null, simulations, first, again)
    if null.case.correction is not None:
        return search  # that is renewed at the answer, and checks the settings there
    best = decision_of(search).best
    search = with_numerics(search, best)
    checked = search.numerics.get(best)
    if checked is None or not checked.may_refine:
        return search
    null.case.progress("search", 0.3, "finer simulations of the best set")
    fit, at = search.fit_of(best), search.simulations.fitted[best]
    try:
        found, _ = corrected_at(fit, at, null.case.settings)
    except DiffsimError:  # finer simulations fail there: the settings stay as they are
        return search
    null, simulations = _under(_with_correction(null.case, found), search, "corrected")
    return _search_from(null, simulations, again=_best_sets(search))


def _search_from(
    null: Null, simulations: Simulations, first: Ends = (), again: Sequence[Members] = ()
) -> Search:
    search = begin(null, simulations)
    for members, x in first:
        search = begin_from(search, members, x)
    for members in again:
        search = refit(search, members)
    fits = search.fits
    if cut := [s for s in again[:1] if s in fits and fits[s].ended == "budget"]:
        search = fitted_to_end(search, cut)  # others are held against it, and begin there
    return search_sets(search)


def _under(case: Case, search: Search, label: str) -> tuple[Null, Simulations]:
    """The plain model and all that was simulated under the correction of a case.

    Args:
        case: Of the search, with another correction.
        label: Where results under it are kept.
    """
    null, new = search.null, case.correction
    assert new is not None
    if case.store is not None:
        told = blake2b(repr(new.key).encode(), digest_size=6).hexdigest()
        case = replace(case, store=case.store.sibling(f"{label}_{told}"))
    problem = case.problem(null.noise.whitener)
    carry = partial(carried, old=null.case.correction, new=new, runs=problem.runs)
    until = case.model.simulations.steps + case.settings.plain_steps
    ended = gauss_newton(problem, carry(null.at), best_cost=search.best_cost(), until=until)
    null = Null(case, null.noise, *ended, null.num_spikes, null.num_misread)
    return null, search.simulations.moved(null, carry, case.store)


def _set_at(wide: Problem, begin_at: Begin) -> tuple[Members, Array]:
    """The set of causes whose sizes a begin knows, and its point."""
    members = frozenset(
        k
        for k, effect in enumerate(wide.effects)
        if any(wide.names[i] in begin_at.sizes for i in wide.columns_of(effect))
    )
    own = Simulations(wide).coordinates(members)
    known = [begin_at.base if i < wide.num_base else begin_at.sizes for i in own]
    return members, np.array([of.get(wide.names[i], 0.0) for i, of in zip(own, known, strict=True)])


def _store_anew(null: Null) -> Null:
    """With a store of its own: what is kept there holds for one choice of numerical settings."""
    if (before := null.case.store) is None:
        return null
    store = Store(before.folder.parent, _key(null.case), before.tally)
    return replace(null, case=replace(null.case, store=store))


def _make_case(
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
    settings = settings or DiagnosisSettings()
    if math.isfinite(settings.again_steps):
        message = "again_steps has no effect and will go; leave it out"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
    return Case(
        study=study,
        model=model,
        effects=tuple(e for e in effects if e.name not in unmet),
        unknowns=(*unknowns, *drifts([c.name for c in study.channels])),
        settings=settings,
        progress=progress or silent,
        unmet=unmet,
        begun=model.simulations.work,
    )


def _check_null(
    null: Null, gates: tuple[GateResult, ...], cache: str | Path | None, once: float
) -> tuple[Null, Checks, Simulations]:
    """Numerical settings and gradients at the null fit, everything linearized there."""
    refined = check_numerics(null) if once == 0.0 else None
    found: CorrectionAt | RefinedNull
    if refined is None:
        null, found = corrected(null, once or null.fit.problem.cost())
    else:
        null, found = refined.null, refined
    changes = found.changes
    case = null.case
    gates = (*gates, *found.gates, *windows_gate(case.model, case.study.fit_runs))
    if case.settings.accept_numerics:
        case = replace(case, effects=(*case.effects, *numerical_effects(null.fit, changes)))
    if cache is not None:
        case = replace(case, store=Store(cache, _key(case), case.model.simulations))
    null = replace(null, case=case)
    simulations = Simulations(null.wide, case.store).under(null)
    try:
        at, simulations = simulations.screen(NONE, None)
    except PredictionError:
        null = _without_unsimulable(null)
        case = null.case
        simulations = Simulations(null.wide, case.store).under(null)
        at, simulations = simulations.screen(NONE, None)
    center = simulations.center(NONE, at, 1)
    spent = case.model.simulations.since(case.begun).steps
    share = GRADIENT_SHARE if once == 0.0 else FIRST_SHARE * GRADIENT_SHARE
    case.progress("checks", 0.2, "gradients")
    linear = center.evidence
    gates = (
        *gates,
        *gradient_gate(linear.problem, linear.x0, linear.residual, linear.jacobian, share * spent),
    )
    case.progress("checks", 0.25, "gradients are checked")
    return null, Checks(gates, changes, center), simulations


def _without_unsimulable(null: Null) -> Null:
    """Without candidates that cannot be moved at all at the plain fit: the others can be judged.

    Their usual sizes come of the plain model's motion at its data sheet, which a fit may have made
    several times as large. Each is moved among all of them, at zero: alone a simulation may take
    other steps.
    """
    kept, unmet, wide = [], dict(null.case.unmet), null.wide
    x = np.concatenate([null.at.x, np.zeros(len(wide.names) - len(null.at.x))])
    for effect in null.case.effects:
        try:
            linearization_at(wide, x, wide.columns_of(effect), screen=True)
            kept.append(effect)
        except PredictionError:
            unmet[effect.name] = "at the plain fit not even a small size of it can be simulated"
    return replace(null, case=replace(null.case, effects=tuple(kept), unmet=unmet))


def _judge_search(
    search: Search, checks: Checks, validation: Validation | None, seed: int
) -> tuple[Checks, Judgment]:
    """Repeatability with the effects that the evidence asks for; then names and unknown causes."""
    evident = decision_of(search)
    repeats = repeatability_gate(search.fit_of(evident.best))
    checks = checks.joined(repeats)
    if search.null.noise.is_repeatable and all(g.passed for g in repeats):
        judgment = judge(search, validation, seed)
        return checks.joined(judgment.gates), judgment
    decision = replace(evident, verdict="unrepeatable", rivals=())
    return checks, Judgment(decision, search)


def _key(case: Case) -> str:
    """Hash of everything that changes a simulation."""
    causes = [(e.name, e.kind, e.unit, e.typical, e.components) for e in case.effects]
    generic = [(u.name, type(u).__qualname__) for u in case.unknowns]
    s = case.settings
    correction = None if case.correction is None else case.correction.key
    settings = (s.jacobian, case.numerics, correction)
    return key_of(case.study, case.model, causes, generic, *settings)
