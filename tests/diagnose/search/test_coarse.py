"""Expensive simulations: first answers by coarse ones, corrected by what finer ones say."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.core.errors import DiffsimError
from diffsim.diagnose import diagnose, diagnosis
from diffsim.diagnose.checks.gates import budget_gates
from diffsim.diagnose.checks.numerics import NUMERICS_LAMBDA, could_be_misfit, numerics_gate
from diffsim.diagnose.judge.judge import decision_of
from diffsim.diagnose.judge.stand_ins import OWN_STEP, own_steps
from diffsim.diagnose.search import coarse
from diffsim.diagnose.search import search as searching
from diffsim.diagnose.search.coarse import carried, corrected, renewed_at
from diffsim.diagnose.search.evidence import Hypothesis
from diffsim.diagnose.search.fit import Case, coarsen_first_look, null_fit
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.search import _center, _refit_promising, _refit_rivals, begin, refit
from diffsim.diagnose.search.simulations import Simulations
from diffsim.identify import DiagnosisSettings, Numerics, SearchSettings, SimModel, WhiteNoise
from diffsim.identify.effort import KEEP_NATS
from diffsim.identify.linearization import linearization_at, records_at
from tests.diagnose import toy

STEP = 0.01  # implicit Euler of 10 ms: far too coarse for the toy
DEAR = DiagnosisSettings(search=SearchSettings(max_effects=2, num_refits=2), dear_steps=0.0)


def noisy(hidden=None, times=10.0):
    study = toy.generate(12, hidden, noise=times)
    return replace(study, channels=tuple(replace(c, sd=times * c.sd) for c in study.channels))


def counted(model):
    """A model that counts its scenes by the time step."""
    steps = Counter()

    def build(values, run, numerics):
        steps[numerics.time_step] += len(next(iter(values.values())).reshape(-1))
        return model.build(values, run, numerics)

    return SimModel(build, model.base, model.name, batched=model.batched), steps


def correct_toy(once=1.0):
    study = noisy()
    null = null_fit(Case(study, toy.model(study.runs, STEP), (toy.DELAY, toy.BIAS), (), DEAR))
    return null, *corrected(null, once)


def test_corrected_records_are_the_finer_ones_around_where_they_were_told():
    before, null, found = correct_toy()
    assert all(g.passed for g in found.gates if g.name != "time_step")
    fine = replace(before.fit.problem, numerics=found.correction.finest)
    assert found.correction.finest.time_step < 1.0
    rng = np.random.default_rng(0)
    for _ in range(3):
        x = before.fit.x + 0.1 * rng.normal(size=len(before.fit.x))
        off = fine.whiten_all(null.fit.problem.record(x) - fine.record(x))
        without = fine.whiten_all(before.fit.problem.record(x) - fine.record(x))
        assert np.linalg.norm(off) < 0.1 * np.linalg.norm(without)
    assert renewed_at(null.fit)[1] < NUMERICS_LAMBDA


def test_a_corrected_plain_fit_ends_where_a_plain_fit_does():
    before, null, _ = correct_toy()
    assert null.fit.converged
    cut = replace(before.case, settings=replace(before.case.settings, plain_steps=0.0))
    short, _ = corrected(replace(before, case=cut), 1.0)
    assert short.fit.ended == "budget"


def test_shifts_are_renewed_where_the_answer_is():
    """Told where a plain model had no payload, 1.6 prior sd of damping bent all that was found."""
    _, null, found = correct_toy()
    (good,) = found.correction.finer
    wrong = replace(good, shift=good.shift + np.array([1.5, *np.zeros(len(good.shift) - 1)]))
    bent = replace(found.correction, finer=(wrong,), told=())
    problem = replace(null.fit.problem, correction=bent)
    start = linearization_at(problem, null.fit.x)
    fit = gauss_newton(problem, start)[0]
    new, size = renewed_at(fit)
    assert size > NUMERICS_LAMBDA
    kept = replace(bent, x=fit.x)
    sizes = [np.linalg.norm(problem.whiten_all(c.over(problem.runs))) for c in (new, kept)]
    assert sizes[0] < 0.5 * sizes[1]  # what is added is small, so that it holds around
    runs, renewed = problem.runs, replace(problem, correction=new)
    there = carried(start, bent, new, runs)
    np.testing.assert_allclose(there.record, renewed.record(there.x), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(there.columns, linearization_at(renewed, there.x).columns)


def test_where_no_end_is_in_sight_the_whole_change_counts(monkeypatch):
    monkeypatch.setattr(coarse, "MAX_LEVELS", 1)
    monkeypatch.setattr(coarse, "_next", lambda sizes: 1.0)  # each refinement changes as much again
    given, null, found = correct_toy()
    (gate,) = (g for g in found.gates if g.name == "time_step")
    assert not gate.passed
    finer = replace(given.fit.problem, numerics=Numerics(time_step=0.5))
    change = finer.record(given.at.x) - given.at.record
    (once,) = numerics_gate(given.fit, {"time_step": change})
    assert gate.value > 1.5 * once.value  # refits and one more refinement: nearly twice as much
    assert could_be_misfit(null.fit, found.gates)


def test_steps_of_first_order_are_followed_to_where_they_lead():
    """MuJoCo's are: a sound leg was "numerical", a fine step of its own being out of reach."""
    study = noisy(times=2.0)
    null = null_fit(Case(study, toy.model(study.runs, STEP), (toy.DELAY, toy.BIAS), (), DEAR))
    after, found = corrected(null, null.fit.problem.cost())
    (finer,) = found.correction.finer
    assert finer.before == Numerics(time_step=2.0 * finer.numerics.time_step)
    assert finer.beyond == pytest.approx(1.0, rel=0.4)  # 10 ms are far from the limit
    assert all(gate.passed for gate in found.gates)
    problem, x = null.fit.problem, null.at.x

    def off(record):
        return np.linalg.norm(problem.whiten_all(record - limit))

    limit = replace(problem, numerics=Numerics(time_step=1.0 / 64.0)).record(x)
    finest = replace(problem, numerics=finer.numerics).record(x)
    assert off(after.fit.problem.record(x)) < 0.4 * off(finest)
    assert renewed_at(after.fit)[0].finer[0].beyond == finer.beyond
    # of a run that was not told before; and what is saved are settings that follow as far
    untold = replace(found.correction, told=())
    np.testing.assert_allclose(untold.over(problem.runs), found.correction.over(problem.runs))
    saved = replace(problem, numerics=untold.finest).record(x)
    assert untold.finest.time_step < finer.numerics.time_step and off(saved) < 0.6 * off(finest)


def test_slopes_and_many_points_of_a_corrected_problem_agree_with_its_records():
    _, null, _ = correct_toy()
    problem, x = null.wide, np.append(null.fit.x, [0.2, 0.1])
    at = linearization_at(problem, x)
    record = problem.record(x)
    np.testing.assert_allclose(at.record, record, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(records_at(problem, x[None])[0], record, rtol=0.0, atol=1e-12)
    moved = x.copy()
    moved[0] += 1e-4
    slope = (problem.record(moved) - record) / 1e-4
    np.testing.assert_allclose(slope, at.columns[:, 0], atol=1e-3 * np.abs(slope).max())


def test_a_dear_first_answer_simulates_finely_only_to_be_corrected():
    study = noisy({"bias": 0.3})
    model, steps = counted(toy.model(study.runs, STEP))
    settings = replace(DEAR, refine_budget=1e3)  # a method of first order needs short steps
    report = diagnose(study, model, (toy.BIAS, toy.DELAY), seed=0, settings=settings)
    assert report.named == ("bias",)
    assert max(steps) == 1.0
    fine = sum(count for step, count in steps.items() if step < 1.0)
    assert fine < 0.2 * steps[1.0]  # all were at the refined step before
    # the answer is of the finer settings, which a saved model goes on with
    assert report.settings["numerics"]["time_step"] < 1.0
    assert report.best.problem.reference_numerics == Numerics(**report.settings["numerics"])
    gate = next(g for g in report.gates if g.name == "coarse")
    assert gate.passed and "corrected by finer simulations" in gate.note
    assert any("coarse" in s and s.startswith("The budget ended") for s in report.sentences)


def test_an_answer_that_finer_simulations_cannot_follow_stays_and_says_so(monkeypatch):
    """A clamp that gave took all stiffness beside it: explain ended in an error."""

    def fail(fit):
        raise DiffsimError("no stiffness")

    monkeypatch.setattr(diagnosis, "renewed_at", fail)
    study = noisy({"bias": 0.3})
    settings = replace(DEAR, refine_budget=1e3)
    report = diagnose(study, toy.model(study.runs, STEP), (toy.BIAS,), seed=0, settings=settings)
    gate = next(g for g in report.gates if g.name == "coarse")
    assert not gate.passed and gate.note.endswith("at the plain fit; at the answer they failed")
    assert report.named == ("bias",) and report.causes[0].status == "likely"
    assert "inf" not in " ".join(report.sentences)


def test_a_renewed_search_begins_at_what_was_found(monkeypatch):
    """A payload was found in 27 CPU s, lost where its correction changed and sought twice more."""
    study, begins = noisy({"bias": 0.3}), []
    effects = (toy.DELAY, toy.BIAS, toy.DRAG)
    model = toy.model(study.runs, STEP)
    null = null_fit(diagnosis._make_case(study, model, effects, (), DEAR, None))
    null, _ = corrected(null, 1e3)
    found = diagnosis.search_rounds(null, Simulations(null.wide, null.case.store).under(null))
    best = frozenset({1})
    assert decision_of(found).best == best
    assert all(h.unknown is None for h in found.posteriors), "unknown causes wait"

    def watched(search):
        begins.append(set(search.fits))
        return searching.search_sets(search)

    sizes = iter([2.0 * NUMERICS_LAMBDA, 0.0])  # once another correction, then the same
    told = diagnosis.renewed_at
    monkeypatch.setattr(diagnosis, "search_sets", watched)
    monkeypatch.setattr(diagnosis, "renewed_at", lambda fit: (told(fit)[0], next(sizes)))
    monkeypatch.setattr(searching, "_fit_from_prior", lambda search: pytest.fail("sought anew"))
    monkeypatch.setattr(searching, "has_left_prior", lambda fit: True)
    again, _ = diagnosis._renew_correction(found)
    assert begins and all(best in sets for sets in begins)
    assert again.fit_of(best).ended == "converged" and decision_of(again).best == best
    assert Hypothesis(best, 0) in again.posteriors


def test_simulations_that_are_not_dear_begin_as_they_are():
    study = noisy()
    case = Case(study, toy.model(study.runs, STEP), (), (), replace(DEAR, dear_steps=1e9))
    assert coarsen_first_look(case) == (case, 0.0)
    full = replace(case, settings=DiagnosisSettings())
    assert coarsen_first_look(full) == (full, 0.0)


def test_rivals_for_which_the_budget_is_spent_are_said():
    study = noisy({"bias": 0.3, "delay": 0.03})
    effects = (toy.BIAS, toy.DELAY, toy.STIFFENING, toy.DRAG)
    search = replace(DEAR.search, refit_steps=1.0)
    settings = DiagnosisSettings(search=search)
    report = diagnose(study, toy.model(study.runs), effects, seed=0, settings=settings)
    late = [g for g in report.gates if g.name == "refit_budget"]
    assert (
        late == list(budget_gates(0, int(late[0].value), search, report.null))
        and late[0].value >= 1
    )
    assert any("rival sets were not refitted" in s for s in report.sentences)


def test_a_plain_fit_cut_short_is_said_and_makes_nothing_certain():
    study = noisy({"bias": 0.3})
    cut, whole = (
        diagnose(study, toy.model(study.runs), (toy.BIAS,), seed=0, settings=settings)
        for settings in (DiagnosisSettings(plain_steps=1.0), DiagnosisSettings())
    )
    assert whole.named == cut.named == ("bias",)
    assert "this is a first answer" in cut.headline
    assert "this is a first answer" not in whole.headline
    assert any("the plain model's fit was cut short" in s for s in cut.sentences)
    assert not any("cut short" in s for s in whole.sentences)


def test_a_rival_that_promises_more_is_refitted_though_the_budget_is_spent():
    """A stranger's late encoder was said to lag: its delay, 1,258 nats better, came too late."""
    study = noisy({"delay": 0.03})
    effects = (toy.BIAS, toy.DELAY, toy.STIFFENING, toy.DRAG)
    null = null_fit(Case(study, toy.model(study.runs), effects, (), DiagnosisSettings()))
    search = begin(null, Simulations(null.wide))
    wrong, right = frozenset({0}), frozenset({1})
    center, search = _center(refit(search, wrong), wrong, search.plain)
    after = _refit_rivals(search, center, 0.0)
    assert after.posteriors[Hypothesis(right)].fit is not None
    assert after.nats(Hypothesis(right)) > after.nats(Hypothesis(wrong))
    assert after.num_late >= 1


def test_refits_go_on_where_none_stayed_near_the_data_sheet(monkeypatch):
    """A hung weight came fourth by linear evidence; the first had turned gravity by 20 sd, and took
    the time that a busy machine had."""
    settings = DiagnosisSettings(search=SearchSettings(num_refits=2))
    study = noisy({"delay": 0.03})
    effects = (toy.BIAS, toy.DELAY, toy.STIFFENING, toy.DRAG)
    null = null_fit(Case(study, toy.model(study.runs), effects, (), settings))
    search = begin(null, Simulations(null.wide))
    ranked = [frozenset({k}) for k in range(4)]

    def num_refitted(until):
        made = _refit_promising(search, search.plain, ranked, until)
        return sum(Hypothesis(members) in made.posteriors for members in ranked)

    assert num_refitted(0.0) == 1 and num_refitted(np.inf) == 2
    monkeypatch.setattr(searching, "has_left_prior", lambda fit: True)
    assert num_refitted(0.0) == 4 and num_refitted(np.inf) == 2


def corrected_search(study):
    """A search under a correction, with a delay of either sign fitted."""
    early = replace(toy.DELAY, signed=True)
    null = null_fit(Case(study, toy.model(study.runs, STEP), (early,), (), DEAR))
    null, _ = corrected(null, 1e3)
    return refit(begin(null, Simulations(null.wide)), frozenset({0}))


def gain_of_delay(search):
    return search.nats(Hypothesis(frozenset({0}))) - search.nats(Hypothesis())


def test_what_the_models_own_steps_do_to_a_recording_is_no_cause():
    """A simulation that was recorded to be followed: a false sensor delay of half a step."""
    study = toy.generate(12)
    own = Case(study, toy.model(study.runs, STEP), (), (), DEAR).problem(WhiteNoise(study.channels))
    rng, sd = np.random.default_rng(3), [c.sd for c in study.channels]
    runs = []
    for run in study.runs:
        made = own.predict(run, torch.zeros(own.num_base, dtype=torch.float64)).numpy()
        runs.append(replace(run, measured=made + rng.normal(0.0, sd, made.shape)))
    search = corrected_search(replace(study, runs=tuple(runs)))
    assert gain_of_delay(search) > KEEP_NATS, "finer steps ask for it"
    assert own_steps(search, frozenset({0})) == {0: OWN_STEP}
    # one that the generator hid stays, though steps are as coarse
    hidden = corrected_search(toy.generate(12, {"delay": 0.05}))
    assert gain_of_delay(hidden) > KEEP_NATS
    assert own_steps(hidden, frozenset({0})) == {}
