"""Coarse settings are refined within a budget, and everything goes on with the refined ones."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from diffsim.data.study import Study
from diffsim.diagnose import diagnose
from diffsim.diagnose.checks import numerics as refine
from diffsim.diagnose.checks.numerics import left_over, length, numerics_changes
from diffsim.diagnose.judge.records import CERTAIN, LIKELY
from diffsim.diagnose.search.fit import Case, check_numerics, null_fit
from diffsim.identify import DiagnosisSettings, Effect, Numerics, SearchSettings, SimModel
from diffsim.identify.linearization import Linearization
from tests.diagnose import linear, toy

QUICK = DiagnosisSettings(search=SearchSettings(max_effects=2, num_refits=2))


def noisy(hidden=None):
    """Ten times the noise of the toy: a step of 10 ms is too coarse by a factor of four."""
    study = toy.generate(12, hidden, noise=10.0)
    channels = tuple(replace(c, sd=10.0 * c.sd) for c in study.channels)
    return replace(study, channels=channels)


def case(settings=QUICK, step=0.01):
    study = noisy()
    return Case(study, toy.model(study.runs, step), (toy.DELAY, toy.BIAS), (), settings)


def test_a_coarse_time_step_is_refined_until_it_passes():
    null = null_fit(case())
    found = check_numerics(null)
    assert all(g.passed for g in found.gates)
    numerics = found.null.case.numerics
    assert 1 / 16 <= numerics.time_step <= 0.5 and numerics.mesh == numerics.tolerance == 1.0
    assert found.null.fit.problem.numerics == numerics
    gate = next(g for g in found.gates if g.name == "time_step")
    assert f"refined by {1 / numerics.time_step:g}" in gate.note
    # a first-order method: what refining still changes falls with the step
    before = np.linalg.norm(numerics_changes(null.fit.problem, null.at)["time_step"])
    assert np.linalg.norm(found.changes["time_step"]) < 0.6 * before


def test_numerics_that_a_number_hides_count_by_its_pull_off_its_prior():
    """A change of 10 noise sd along what a prior's width does, 5 noise sd: 10 / sqrt(1 + 5^2)."""
    slopes, change = np.array([[0.0], [3.0], [4.0]]), np.array([0.0, 6.0, 8.0])
    assert length(left_over(change, slopes)) == pytest.approx(10.0 / np.sqrt(26.0))


def test_settings_whose_slopes_would_take_a_search_are_not_used():
    """Then finer simulations correct the coarse ones instead."""
    null = null_fit(case())
    table = null.wide.cost_of_table()
    search = replace(QUICK.search, refit_steps=5.0 * table)  # refined by two: half of it
    settings = replace(QUICK, search=search)
    assert check_numerics(replace(null, case=replace(null.case, settings=settings))) is None


@pytest.mark.parametrize(("budget", "may_refine"), [(8.0, True), (1.5, False), (1.0, False)])
def test_a_set_asks_for_finer_settings_where_the_budget_allows_any(budget, may_refine):
    settings = replace(QUICK, refine_budget=budget)
    null = null_fit(case(settings))
    found = refine.check_numerics_of_set(null.fit, null.at.record, settings)
    gate = next(g for g in found.gates if g.name == "time_step")
    assert not gate.passed and found.may_refine == may_refine
    assert ("than the budget" in gate.note) != may_refine


class Costly(SimModel):
    """A model whose predictions cost as stated, whatever they take on this machine."""

    def __init__(self, plain, dear, build=None):
        super().__init__(build or plain.build, plain.base)
        self.dear = dear

    def cost(self, run, numerics=None):
        return self.dear(numerics or Numerics())


def test_a_budget_that_is_spent_is_said_with_figures():
    coarse = case(replace(QUICK, refine_budget=1.2))
    model = Costly(coarse.model, lambda numerics: 20.0 / numerics.time_step)
    found = check_numerics(null_fit(replace(coarse, model=model)))
    gate = next(g for g in found.gates if g.name == "time_step")
    assert not gate.passed and "budget of 1.2 times" in gate.note


def test_a_setting_beyond_the_budget_does_not_keep_others_coarse():
    """An error that only a mesh finer by far takes out, which costs a hundred times as much."""
    coarse = case()
    plain = coarse.model

    class Off:
        def __init__(self, scene, error):
            self.scene, self.error = scene, error

        def __getattr__(self, name):
            return getattr(self.scene, name)

        def simulate(self):
            return self.scene.simulate() + self.error

    def build(values, run, numerics):
        return Off(plain.build(values, run, numerics), 5.0 * numerics.mesh)

    model = Costly(plain, lambda numerics: 10.0 if numerics.mesh == 1.0 else 1000.0, build)
    numerics = check_numerics(null_fit(replace(coarse, model=model))).null.case.numerics
    assert numerics.mesh == 1.0 and numerics.time_step < 1.0


@pytest.mark.parametrize("settings", [replace(QUICK, accept_numerics=True), QUICK])
def test_settings_that_pass_or_are_accepted_stay(settings):
    step = 0.01 if settings.accept_numerics else None
    null = null_fit(case(settings, step))
    found = check_numerics(null)
    assert found.null is null and null.case.numerics is None


def test_a_diagnosis_goes_on_with_refined_settings():
    study = noisy({"bias": 0.3})
    model = toy.model(study.runs, 0.01)
    report = diagnose(
        study,
        model,
        (toy.BIAS, toy.DELAY),
        seed=0,
        settings=QUICK,
    )
    assert report.named == ("bias",)
    finer = Numerics(**report.settings["numerics"])
    assert finer.time_step < 1.0
    assert report.best.problem.numerics == report.null.problem.numerics == finer


def test_what_a_budget_cut_short_is_likely_and_a_full_answer_makes_certain():
    study = noisy({"bias": 0.6})
    for steps, status, word in ((1.0, LIKELY, " probably "), (np.inf, CERTAIN, "")):
        search = replace(QUICK.search, refit_steps=steps)
        settings = replace(QUICK, search=search, plain_steps=max(8e6, steps))
        report = diagnose(study, toy.model(study.runs), (toy.BIAS,), seed=0, settings=settings)
        assert (report.verdict, report.named) == ("named", ("bias",))
        assert [c.status for c in report.causes if c.name == "bias"] == [status]
        assert (" probably missing" in report.headline) == (status == LIKELY)
        assert f"The model{word or ' '}lacks" in report.sentences[0]
        assert any(t.startswith("A first answer") for t in report.sentences) == (status == LIKELY)


@dataclass
class Meshy(linear.LinearScene):
    """A scene with a cause that a coarse mesh draws as if another acted beside it."""

    mesh: float = 1.0


def kink():
    def apply(scene, size, run):
        seen = linear.shapes("kink", run) + 0.5 * scene.mesh * linear.shapes("other", run)
        return replace(scene, record=scene.record + seen @ size)

    return Effect(name="kink", family="kink", kind="force", unit="N", typical=4.0, apply=apply)


def diagnosed_kink(budget):
    plain, kinked = linear.model(), kink()

    def build(values, run, numerics):
        return Meshy(plain.build(values, run, numerics).record, numerics.mesh)

    def recorded(name, seed):
        run = linear.run(name, seed)
        return replace(
            run, measured=run.measured + 6.0 * linear.shapes("kink", run)[..., 0].numpy()
        )

    runs = tuple(recorded(f"r{k}", k) for k in range(4))
    study = Study("kink", "copter", linear.CHANNELS, runs)
    model = SimModel(build, plain.base, "meshy")
    settings = replace(QUICK, refine_budget=budget)
    return diagnose(study, model, (kinked, linear.line("other")), seed=0, settings=settings)


def test_settings_are_fine_enough_for_the_named_cause():
    """The plain model passes the gate; what names the cause does not."""
    report = diagnosed_kink(budget=1e9)
    assert report.named == ("kink",)
    assert report.settings["numerics"]["mesh"] <= 0.25
    gate = next(g for g in report.gates if g.name == "mesh")
    assert gate.passed and "with the named causes" in gate.note
    assert report.best.problem.correction.finest == Numerics(**report.settings["numerics"])


def test_what_a_coarse_mesh_explains_is_not_certain():
    report = diagnosed_kink(budget=1.0)
    assert report.named == ("kink",)
    other = next(row for row in report.causes if row.name == "other")
    assert other.status == LIKELY and "too coarse a mesh" in other.rivals
    assert any(s.startswith("A check failed: a finer mesh ") for s in report.sentences)


def test_a_step_that_is_no_coarser_in_effect_is_refined_beyond_the_models_own():
    """Steps end at samples at the latest: half of twice the step was the same, and passed."""
    plain = linear.model()

    def build(values, run, numerics):
        scene = plain.build(values, run, numerics)
        return replace(scene, record=scene.record + 9.0 * min(numerics.time_step, 1.0))

    model = SimModel(build, plain.base, "stepped")
    problem = replace(linear.problem(), model=model, numerics=Numerics(time_step=2.0))
    x = np.zeros(len(problem.names))
    at = Linearization(x, problem.record(x), (), np.zeros((len(x), 0)))
    np.testing.assert_allclose(numerics_changes(problem, at)["time_step"], -4.5)
