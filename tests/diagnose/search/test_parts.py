"""What is left of a set of causes: parts that nobody had fitted, effects at zero, fits that end."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.diagnose.judge.gain import validation_of
from diffsim.diagnose.judge.judge import judge
from diffsim.diagnose.search import search as searching
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.diagnose.search.fit import Case, null_fit
from diffsim.diagnose.search.search import begin, fitted_to_end, refit
from diffsim.diagnose.search.simulations import NONE, Simulations
from diffsim.identify import DiagnosisSettings, SearchSettings, SimModel
from diffsim.identify.effort import KEEP_NATS
from tests.diagnose import toy

BOTH, DELAY = frozenset({0, 1}), frozenset({0})


def search_of_a_pair(drag=0.0):
    """A delay is missing, alone or with a drag; with a drag it is the only set that was fitted."""
    study = toy.generate(4, {"delay": 0.03, "drag": drag})
    settings = DiagnosisSettings(search=SearchSettings(max_effects=2))
    model = toy.model(study.runs)
    null = null_fit(Case(study, model, (toy.DELAY, toy.DRAG), (), settings))
    search = refit(begin(null, Simulations(null.wide)), BOTH)
    assert set(search.fits) == {NONE, BOTH}
    return search, study


def search_of_a_pair_with_a_part_cut(drag=0.0):
    """The delay alone is fitted, too, though not from where it begins."""
    search, study = search_of_a_pair(drag)
    made = search.simulations
    start = made.start(DELAY, search.plain.at, search.plain.weigh(DELAY).x)
    fit, at = made.fitted_from(DELAY, start, np.inf, most=0.0)
    return replace(search, simulations=made.kept(DELAY, at)).with_fit(DELAY, fit), study


def test_a_part_that_is_enough_is_named_though_only_the_judge_fits_it():
    search, study = search_of_a_pair()
    validation = validation_of(search.fit_of(NONE), study.select_runs)
    assert validation is not None
    assert judge(search, validation, 0).decision.best == DELAY


def test_a_fit_ends_where_its_steps_are_spent():
    search, _ = search_of_a_pair()
    made = search.simulations
    start = made.start(DELAY, search.plain.at, search.plain.weigh(DELAY).x)
    cut, _ = made.fitted_from(DELAY, start, np.inf, most=0.0)
    assert cut.ended == "budget" and cut.num_evaluations == 1
    whole, _ = made.fitted_from(DELAY, start, np.inf)
    assert whole.converged and whole.num_evaluations > 1


def test_a_part_whose_fit_a_budget_had_ended_is_fitted_on():
    """Its cost is no gain of the member that it lacks: dry friction of a servo, cut short, lost to
    a backlash beside it."""
    cut, study = search_of_a_pair_with_a_part_cut()
    assert cut.nats(Hypothesis(BOTH)) - cut.nats(Hypothesis(DELAY)) > KEEP_NATS
    whole = fitted_to_end(cut, [DELAY])
    assert whole.fit_of(DELAY).converged and not cut.fit_of(DELAY).converged
    validation = validation_of(cut.fit_of(NONE), study.select_runs)
    assert judge(cut, validation, 0).decision.best == DELAY


def test_a_part_that_ended_far_above_what_the_whole_promises_is_fitted_from_there():
    """From the plain model an arm's payload stayed at 31,644 where with a dead band it left 4,969:
    the dead band was said to be missing."""
    cut, study = search_of_a_pair_with_a_part_cut()
    stuck = cut.with_fit(DELAY, replace(cut.fit_of(DELAY), ended="converged"))
    assert fitted_to_end(stuck, [DELAY]) is stuck
    mended = fitted_to_end(stuck, [DELAY], BOTH).fit_of(DELAY)
    assert mended.converged and mended.chi2 < stuck.fit_of(DELAY).chi2 - 100.0
    validation = validation_of(stuck.fit_of(NONE), study.select_runs)
    assert judge(stuck, validation, 0).decision.best == DELAY


def test_a_part_is_fitted_from_there_though_it_is_no_rival_of_the_whole():
    """A delay inside a controller stayed at 146,085 where it leaves 1,632: a lag of the sensor
    beside it, worth 67, was said to remove 14 % of all that was missing."""
    cut, _ = search_of_a_pair_with_a_part_cut(drag=0.006)
    stuck = cut.with_fit(DELAY, replace(cut.fit_of(DELAY), ended="converged"))
    mended = fitted_to_end(stuck, [DELAY], BOTH)
    assert mended.fit_of(DELAY).chi2 < stuck.fit_of(DELAY).chi2 - 100.0
    least = mended.nats(Hypothesis(DELAY)) + stuck.settings.rival_nats
    assert mended.nats(Hypothesis(BOTH)) > least


def test_effects_act_only_at_points_where_they_are_not_zero():
    study, seen = toy.generate(4), []
    given = toy.model(study.runs)
    model = SimModel(given.build, given.base, given.name)
    model.leaves_zeros = True

    def apply(scene, size, run):
        seen.append(float(size))
        return toy.DELAY.apply(scene, size, run)

    delay = replace(toy.DELAY, apply=apply)
    points = torch.zeros(3, len(model.base), dtype=torch.float64)
    sizes = torch.tensor([[0.0], [0.02], [0.0]], dtype=torch.float64)
    with torch.no_grad():
        plain, late, again = model.predict_many(study.runs[0], points, {delay: sizes})
    assert seen == [0.02]
    assert torch.equal(plain, again) and not torch.equal(plain, late)


def test_a_fit_that_its_budget_ended_goes_on_from_there_and_not_from_another_start(monkeypatch):
    search, _ = search_of_a_pair()
    begun, ends, fitted_from = [], [], Simulations.fitted_from

    def cut_short(self, members, start, *args):
        begun.append(start.x[self.coordinates(members)])
        fit, at = fitted_from(self, members, start, *args)
        ends.append(at.x)
        is_last = len(ends) == 3
        return replace(fit, ended="converged" if is_last else "budget", chi2=1e6 - len(ends)), at

    monkeypatch.setattr(Simulations, "fitted_from", cut_short)
    monkeypatch.setattr(searching, "_starts", lambda search, *_: [search.plain] * 3)
    monkeypatch.setattr(searching, "_disappoints", lambda *_: True)
    assert DELAY in refit(search, DELAY).fits
    assert np.abs(ends[0] - begun[0]).max() > 0.1
    assert [list(x) for x in begun[1:]] == [pytest.approx(list(x)) for x in ends[:-1]]
