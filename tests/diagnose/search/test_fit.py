"""Fits that simulate little, against scipy's, and what they keep."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.diagnose.search import gauss_newton as gauss_newton_module
from diffsim.diagnose.search.fit import first_fit
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.simulations import NONE, Simulations
from diffsim.identify import Parameter, Problem, SimModel, WhiteNoise, fit
from diffsim.identify.linearization import Linearization, linearization_at
from diffsim.identify.problem import PredictionError
from tests.diagnose import linear, toy


@pytest.fixture(scope="module")
def study():
    found = toy.generate(2, {"drag": 0.2})
    return replace(found, runs=tuple(r for r in found.runs if r.group == "chirp"))


def problem_of(study, effects=()):
    model = toy.model(study.fit_runs)
    return Problem(model, study.fit_runs, WhiteNoise(study.channels), effects)


@pytest.mark.reference
@pytest.mark.parametrize("effects", [(), (toy.DRAG,), (toy.DRAG, toy.DELAY)])
def test_same_minimum_as_scipy_for_fewer_simulations(study, effects):
    problem = problem_of(study, effects)
    truth = fit(problem.model, problem.runs, study.channels, effects=effects)
    paid = problem.model.simulations.count
    found, _ = gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))
    spent = problem.model.simulations.count - paid
    assert found.converged
    # both stop where a step promises less than some hundredths of a nat
    assert abs(found.chi2 + found.prior - truth.chi2 - truth.prior) < 0.2
    np.testing.assert_allclose(
        found.x, truth.x, atol=0.3 * np.sqrt(np.diag(truth.covariance)).max()
    )
    np.testing.assert_allclose(np.diag(found.covariance), np.diag(truth.covariance), rtol=0.15)
    # from the prior both must linearize several times; from a neighbor it is a step or two
    assert spent < 0.7 * paid


def test_a_curved_valley_is_followed_to_its_end():
    """v = u^2, stiffly: the way along it is much longer than the slopes of a place hold."""
    run = linear.run("r1", 1)
    across, along = (linear.shapes(name, run)[..., 0] for name in ("across", "along"))

    def build(values, run, numerics):
        u, v = values["u"], values["v"]
        return linear.LinearScene(30.0 * (v - u * u) * across + u * along)

    base = [Parameter("u", -1.0, 5.0, "m"), Parameter("v", 1.0, 5.0, "m")]
    model = SimModel(build, base, "valley")
    truth = build({"u": torch.tensor(2.0), "v": torch.tensor(4.0)}, run, None).record
    runs = (replace(run, measured=run.measured + truth.numpy()),)
    problem = Problem(model, runs, WhiteNoise(linear.CHANNELS), ())
    found, _ = gauss_newton(problem, linearization_at(problem, np.zeros(2)))
    assert found.converged
    # 242 where every step off the slopes is followed by shorter ones and by new slopes, 197 where
    # one that leaves the valley is not followed by the one back
    assert model.simulations.count < 180
    best = fit(model, runs, linear.CHANNELS, max_evaluations=200)
    assert best.converged
    assert abs(found.chi2 + found.prior - best.chi2 - best.prior) < 0.1


def test_a_fit_ends_where_its_budget_is_spent(study):
    problem = problem_of(study)
    start = linearization_at(problem, np.zeros(len(problem.names)))
    most = problem.model.simulations.steps
    found, end = gauss_newton(problem, start, until=most)
    assert found.ended == "budget" and "budget" in found.message
    # it ends with the step that passes the count
    assert 0 < found.num_evaluations < gauss_newton(problem, start)[0].num_evaluations
    before = problem.model.simulations.count
    again, _ = gauss_newton(problem, end, until=most)
    assert again.num_evaluations == 0 and problem.model.simulations.count == before


def test_slopes_from_elsewhere_find_the_same_place(study):
    problem = problem_of(study)
    there, _ = gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))
    far = np.zeros(len(problem.names))
    far[:3] = 1.0
    wrong = replace(
        linearization_at(problem, far),
        x=np.zeros(len(far)),
        record=problem.record(0 * far),
        slope_error=1.0,
    )
    found, _ = gauss_newton(problem, wrong)
    assert found.converged
    assert abs(found.chi2 + found.prior - there.chi2 - there.prior) < 0.2


def test_nothing_is_simulated_at_the_minimum_and_an_outranked_set_is_left_early(study):
    problem = problem_of(study)
    there, end = gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))
    before = problem.model.simulations.count
    again, _ = gauss_newton(problem, end)
    np.testing.assert_array_equal(again.x, there.x)
    assert problem.model.simulations.count == before
    start = linearization_at(problem, np.zeros(len(problem.names)))
    before = problem.model.simulations.count
    gauss_newton(problem, start, best_cost=-1e9)
    assert problem.model.simulations.count == before


def test_a_fit_ends_where_a_step_promises_less_than_is_asked(study, monkeypatch):
    nats = 50.0
    problem = problem_of(study, (toy.DRAG, toy.DELAY))
    spent, ends = [], []
    for least in (gauss_newton_module.FIT_NATS, nats):
        monkeypatch.setattr(gauss_newton_module, "FIT_NATS", least)
        before = problem.model.simulations.count
        found, _ = gauss_newton(problem, linearization_at(problem, np.zeros(len(problem.names))))
        assert found.converged
        ends.append(0.5 * (found.chi2 + found.prior))
        spent.append(problem.model.simulations.count - before)
    assert spent[1] < spent[0]
    assert ends[1] - ends[0] < nats


def test_unsigned_sizes_stay_at_their_bound():
    effect = linear.line("push", signed=False)
    shape = linear.shapes("push", linear.run("r1", 1)).numpy()[..., 0]
    run = linear.run("r1", 1)
    problem = linear.problem((effect,), [replace(run, measured=run.measured - 3.0 * shape)])
    found, _ = gauss_newton(problem, linearization_at(problem, np.zeros(3)))
    assert found.x[2] == 0.0 and found.at_bound == ("push",)
    truth = fit(problem.model, problem.runs, linear.CHANNELS, effects=(effect,))
    np.testing.assert_allclose(found.x, truth.x, atol=1e-4)


def test_records_do_not_depend_on_the_noise(study):
    problem = problem_of(study)
    at = linearization_at(problem, np.zeros(len(problem.names)))
    double = [replace(c, sd=2.0 * c.sd) for c in study.channels]
    other = replace(problem, whitener=WhiteNoise(double))
    residual, jacobian = other.linearize(np.zeros(len(problem.names)))
    np.testing.assert_allclose(other.residual_of(at.record), residual)
    np.testing.assert_allclose(other.whiten_all(at.columns), jacobian)


def test_only_effects_that_stand_out_are_differentiated_again(study):
    wide = problem_of(study, (toy.DRAG, toy.SCALE, toy.WARMING, toy.BIAS))
    made = Simulations(wide)
    plain = made.narrow(NONE)
    _, at = gauss_newton(plain, linearization_at(plain, np.zeros(7)))
    screened, made = made.kept(NONE, at).screen(NONE, None)
    assert set(screened.idx) == set(range(11))
    drag = frozenset({0})
    _, at = made.fitted_from(drag, made.start(drag, screened, screened.x), 0.0)
    made = made.kept(drag, at)
    before = wide.model.simulations.count
    again, _ = made.screen(drag, screened)
    # one or two of the three others at most, by noise: two simulations of both runs each
    assert wide.model.simulations.count - before <= 2 * (1 + 4)
    assert set(again.idx) == set(range(11))


def test_joined_keeps_its_own_slopes():
    a = Linearization(np.zeros(3), np.zeros(2), (0,), np.ones((2, 1)))
    b = Linearization(np.zeros(3), np.zeros(2), (0, 2), np.full((2, 2), 5.0))
    both = a.joined(b)
    np.testing.assert_array_equal(both.slopes([2, 0]), [[5.0, 1.0]] * 2)


@pytest.mark.parametrize("least", [0.0, 1e-200])  # no number, and one whose square is none
def test_a_slope_that_leaves_the_range_of_numbers_names_its_coordinate(study, least):
    def brittle(scene, size, run):
        return toy.BIAS.apply(scene, size / torch.where(size == 0.0, 1.0, least), run)

    problem = problem_of(study, (toy.DRAG, replace(toy.BIAS, apply=brittle)))
    with pytest.raises(PredictionError, match="small step along bias;"):
        linearization_at(problem, np.zeros(len(problem.names)))


def test_a_linear_answer_beyond_a_bound_starts_at_the_bound():
    effects = (linear.line("push"), linear.line("pull"))
    wide = linear.problem(effects)
    heavy = replace(wide.model.base[0], upper=0.4)  # prior 0.3 +- 0.7: one seventh of an sd
    wide = replace(wide, model=SimModel(wide.model.build, [heavy, wide.model.base[1]]))
    made = Simulations(wide)
    swapped = frozenset({1})
    center = linearization_at(wide, np.array([0.1, 0.0, 0.5, 0.0]))
    start = made.start(swapped, center, np.array([9.0, 0.0, 0.0, 0.3]))
    np.testing.assert_allclose(start.x, [1.0 / 7.0, 0.0, 0.0, 0.3])
    np.testing.assert_allclose(start.record, wide.record(start.x))
    found, _ = made.fitted_from(swapped, start, 0.0)
    assert found.converged and found.values["mass"] <= 0.4 + 1e-12


def test_windows_in_which_nothing_was_measured_are_skipped():
    """A run-up is simulated, but not measured: a fit to it would be one to no sample."""

    def build(values, run, numerics):
        time = torch.from_numpy(run.time_s)
        return linear.LinearScene(values["slope"] * time[:, None].expand(-1, 2))

    run = linear.run("late", 1)
    measured = 200.0 + run.measured  # far from any line through zero: windows are tried
    measured[:12] = np.nan
    model = SimModel(build, [Parameter("slope", 1.0, 1.0)], "line")
    problem = Problem(model, (replace(run, measured=measured),), WhiteNoise(linear.CHANNELS))
    found, _ = first_fit(problem, (0.25, 0.95))
    alone, _ = first_fit(problem, ())
    assert found.chi2 + found.prior == pytest.approx(alone.chi2 + alone.prior, rel=1e-6)
