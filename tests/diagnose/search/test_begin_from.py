"""A search that is made again with finer settings, where the budget does not last for all of it."""

import math
from dataclasses import replace

import pytest

from diffsim.diagnose import diagnosis
from diffsim.diagnose.checks.numerics import SetNumerics
from diffsim.diagnose.judge.judge import decision_of
from diffsim.diagnose.search.fit import Case, null_fit, refit_under
from diffsim.diagnose.search.search import begin, begin_from, refit, search_sets
from diffsim.diagnose.search.simulations import Simulations
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


def test_only_a_search_that_would_be_cut_short_begins_at_an_earlier_end(monkeypatch):
    begun = []

    def watched(search, members, x):
        begun.append(names(search, members))
        return begin_from(search, members, x)

    monkeypatch.setattr(diagnosis, "begin_from", watched)
    for steps, expected in ((math.inf, []), (1.0, [BOTH])):
        begun.clear()
        null = plain(steps)
        null = replace(null, case=replace(null.case, model=toy.model(null.case.study.runs, 0.02)))
        diagnosis._search_fine_enough(null, Simulations(null.wide).under(null))
        assert begun[:1] == expected
        # and at the best set without each of its causes: coarse steps may have put one behind
        assert len(begun) == 3 * len(expected) and not any(less >= BOTH for less in begun[1:])


def test_repeats_under_finer_settings_share_one_budget(monkeypatch):
    """Each of a pendulum's three searches took less than its budget, all of them five times it."""
    spent: list[tuple[int, bool]] = []

    def never_enough(search, members, *, is_late=False):
        spent.append((search.steps, is_late))
        finer = (search.wide.numerics or Numerics()).refined(Numerics(time_step=0.5))
        found = SetNumerics({}, (), finer)
        return replace(search, numerics={**search.numerics, members: found})

    monkeypatch.setattr(diagnosis, "with_numerics", never_enough)

    def rounds(again: float) -> list[bool]:
        spent.clear()
        null = plain()
        begun = null.case.model.simulations.steps
        settings = replace(null.case.settings, again_steps=again)
        null = replace(null, case=replace(null.case, settings=settings, searching=begun))
        diagnosis._search_fine_enough(null, Simulations(null.wide).under(null))
        spent[:] = [(steps - begun, is_late) for steps, is_late in spent]
        return [is_late for _, is_late in spent]

    assert len(rounds(math.inf)) == diagnosis.MAX_RENEWALS
    first, second = (steps for steps, _ in spent[:2])
    longest = max(first, second - first)
    assert longest < second and rounds(0.5 * (longest + second)) == [False, True]
