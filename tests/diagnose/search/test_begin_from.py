"""A search whose best set needs finer settings: corrected there, or made again from there."""

import math
from dataclasses import replace

import pytest

from diffsim.diagnose import diagnosis
from diffsim.diagnose.checks.gates import CORRECTED
from diffsim.diagnose.checks.numerics import NUMERICS_LAMBDA, length
from diffsim.diagnose.judge.judge import decision_of
from diffsim.diagnose.search.fit import Case, null_fit, refit_under
from diffsim.diagnose.search.search import (
    begin,
    begin_from,
    refit,
    search_sets,
    with_numerics,
)
from diffsim.diagnose.search.simulations import Simulations
from diffsim.diagnose.search.store import Store
from diffsim.identify import DiagnosisSettings, Numerics, SearchSettings
from tests.diagnose import toy

SETTINGS = DiagnosisSettings(search=SearchSettings(max_effects=2, num_refits=1))
BOTH = {"bias", "delay"}


def plain(steps=math.inf):
    study = toy.generate(12, {"bias": 0.3, "delay": 0.03})
    settings = replace(SETTINGS, search=replace(SETTINGS.search, refit_steps=steps))
    effects = (toy.DELAY, toy.BIAS, toy.DRAG)
    return null_fit(Case(study, toy.model(study.runs, 0.005), effects, (), settings))


def start(null):
    return begin(null, Simulations(null.wide).under(null))


def names(search, members):
    return {search.wide.effects[i].name for i in members}


def best_of(search):
    return names(search, decision_of(search).best)


@pytest.fixture(scope="module")
def coarse():
    return search_sets(start(plain()))


def finer(steps):
    return start(refit_under(plain(steps), Numerics(time_step=0.5)))


def test_what_was_found_is_not_lost_where_the_budget_is_spent(coarse):
    best = decision_of(coarse).best
    assert names(coarse, best) == BOTH
    begun = begin_from(finer(1.0), best, coarse.fit_of(best).x)
    assert len(begun.fits) == 2  # the plain model and the set: nothing on the way to it
    again = search_sets(begun)
    assert best_of(again) == BOTH
    assert again.fit_of(best).problem.numerics == Numerics(time_step=0.5)


def test_a_cause_that_finer_settings_do_not_ask_for_is_left(coarse):
    """Found with coarse steps, it may be no more than what they do wrong."""
    both, three = decision_of(coarse).best, frozenset(range(3))
    more = refit(coarse, three)
    again = search_sets(begin_from(finer(math.inf), three, more.fit_of(three).x))
    assert decision_of(again).best == both


def rounds(monkeypatch, step, holds, budget=float("inf")):
    """A search by long steps, and the sets at which another one by shorter steps begins."""
    begun = []

    def watched(search, members, x):
        begun.append(names(search, members))
        return begin_from(search, members, x)

    monkeypatch.setattr(diagnosis, "begin_from", watched)
    told = diagnosis.corrected_at
    sizes = None if holds else iter((9.0, 3.0, 4.0))  # as of friction that sticks by long steps

    def told_worse(*given):
        found, size = told(*given)
        return found, size if sizes is None else next(sizes)

    monkeypatch.setattr(diagnosis, "corrected_at", told_worse)
    null = plain()
    null = replace(null, case=replace(null.case, model=toy.model(null.case.study.runs, step)))
    made = diagnosis.search_rounds(null, Simulations(null.wide).under(null))
    assert made.null.case.correction is not None and made.null.case.beyond is not None
    case = made.null.case
    ended = replace(case.settings, search=replace(case.settings.search, refit_steps=budget))
    made = replace(made, null=replace(made.null, case=replace(case, settings=ended)))
    return begun, *diagnosis._renew_correction(made)


def test_long_steps_are_corrected_by_short_ones_at_the_best_set(monkeypatch):
    begun, search, gates = rounds(monkeypatch, 0.01, holds=True)
    assert best_of(search) == BOTH and not begun
    assert [g.passed for g in gates] == [True]
    fit = search.fit_of(decision_of(search).best)
    fine = replace(fit.problem, correction=None, numerics=fit.problem.correction.finest)
    off = fit.problem.whiten_all(fine.record(fit.x) - fit.problem.record(fit.x))
    rough = replace(fine, numerics=None)
    without = fit.problem.whiten_all(fine.record(fit.x) - rough.record(fit.x))
    assert length(off) < NUMERICS_LAMBDA < length(without)


def test_where_corrections_do_not_hold_short_steps_are_taken_from_what_was_found(monkeypatch):
    begun, search, gates = rounds(monkeypatch, 0.02, holds=False)
    assert best_of(search) == BOTH and not gates
    assert begun[0] == BOTH  # then without each of its causes: long steps may have put one behind
    assert len(begun) > 1 and not any(less >= BOTH for less in begun[1:])
    assert search.null.case.correction is None and search.wide.numerics.time_step < 1.0


def test_corrections_are_made_again_once_where_the_budget_is_spent(monkeypatch):
    """A servo's were six times, and then all was searched anew: 400 CPU s in place of 120."""
    begun, search, gates = rounds(monkeypatch, 0.02, holds=False, budget=1.0)
    assert not begun and search.null.case.correction is not None
    assert search.is_cut_short and not gates[0].passed and gates[0].value == 4.0


def test_gates_of_a_correction_are_those_of_the_answer(monkeypatch):
    told, keep = [], diagnosis._with_correction

    def watched(case, found):
        told.append(found)
        return keep(case, found)

    monkeypatch.setattr(diagnosis, "_with_correction", watched)
    _, search, gates = rounds(monkeypatch, 0.01, holds=True)
    best = decision_of(search).best
    found = with_numerics(search, best).numerics[best]
    assert all(gate.passed and "named causes" in gate.note for gate in found.gates)
    assert len(told) > 2 and found.changes is told[-1].changes
    assert "an earlier set" in gates[0].note
    assert gates[0].name == CORRECTED and not search.is_cut_short  # it may be certain


def test_what_is_kept_of_one_correction_is_not_read_by_another(coarse, tmp_path):
    """Slopes under one that a larger budget had made were taken from the folder."""
    folders, case = [], coarse.null.case
    store = Store(tmp_path, diagnosis._key(case), case.model.simulations)
    for members in [members for members in coarse.fits if members][:2]:
        fit, at = coarse.fit_of(members), coarse.simulations.fitted[members]
        found, _ = diagnosis.corrected_at(fit, at, case.settings)
        kept = diagnosis._with_correction(replace(case, store=store), found)
        folders.append(diagnosis._under(kept, coarse, "corrected")[0].case.store.folder)
    assert folders[0] != folders[1]


def test_a_setting_without_effect_says_so():
    study = toy.generate(12)
    settings = DiagnosisSettings(again_steps=1.0)
    with pytest.warns(DeprecationWarning, match="again_steps"):
        diagnosis._make_case(study, toy.model(study.runs), (), (), settings, None)
