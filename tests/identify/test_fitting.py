from dataclasses import replace

import numpy as np
import pytest
import torch

from diffsim.data.study import Channel, Run
from diffsim.identify import Jacobian, Parameter, Problem, SimModel, WhiteNoise, fit
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.problem import PredictionError
from tests.diagnose import linear

TIME = np.linspace(0.0, 2.0, 41)
CHANNEL = (Channel("x_m", "m", "position", sd=0.02),)


class Decay:
    def __init__(self, values, run):
        self.values, self.run = values, run

    def simulate(self):
        t, v = torch.from_numpy(self.run.time_s), self.values
        swing = torch.exp(-v["rate"][..., None] * t) * torch.cos(v["omega"][..., None] * t)
        return (swing + v[f"offset@{self.run.name}"][..., None])[..., None]


def decay_model(names=("a", "b"), rate_upper=np.inf):
    base = [
        Parameter("rate", 0.5, 0.5, "1/s", log=True, upper=rate_upper),
        Parameter("omega", 6.0, 0.1, "rad/s", log=True),
        *(Parameter(f"offset@{n}", 0.0, 0.1, "m") for n in names),
    ]
    return SimModel(lambda values, run, numerics: Decay(values, run), base, batched=True)


def decay_runs(rate=0.8, omega=6.5, offsets=(0.05, -0.08), seed=0, noise=0.02):
    rng = np.random.default_rng(seed)
    runs = []
    for name, offset in zip("ab", offsets, strict=True):
        x = np.exp(-rate * TIME) * np.cos(omega * TIME) + offset
        x = x + noise * rng.normal(size=x.shape)
        runs.append(Run(name, TIME, x[:, None], {}, name))
    return runs


@pytest.mark.reference
def test_linear_posterior_is_the_closed_form():
    """Without sizes, whose prior is not normal."""
    found = fit(linear.model(), [linear.run("r1", 1), linear.run("r2", 2)], linear.CHANNELS)
    y, a = linear.matrices()
    covariance = np.linalg.inv(a.T @ a + np.eye(2))
    mean = covariance @ a.T @ y
    sd = np.sqrt(np.diag(covariance))
    assert found.converged
    np.testing.assert_allclose(found.x, mean, atol=1e-7)
    np.testing.assert_allclose(list(found.sd.values()), sd * [0.7, 1.5], rtol=1e-7)
    np.testing.assert_allclose(found.correlation, covariance / np.outer(sd, sd), atol=1e-7)
    np.testing.assert_allclose(found.values["mass"], 0.3 + 0.7 * mean[0], atol=1e-7)
    np.testing.assert_allclose(found.chi2, np.sum((y - a @ mean) ** 2), rtol=1e-7)


@pytest.mark.reference
@pytest.mark.parametrize("rows", [[0, 1], [1, 0]])
def test_slopes_of_many_decades_leave_no_negative_variance(rows):
    """A = [[k, k], [0, 1]]: (A'A + 1)^-1 is [[1, -1], [-1, 1]] / 3 for large k."""
    slopes = np.array([[1e30, 1e30], [0.0, 1.0]])[rows]
    covariance = posterior_covariance(slopes)
    np.testing.assert_allclose(covariance, np.array([[1, -1], [-1, 1]]) / 3.0, rtol=1e-12)


def test_known_truth_without_noise():
    found = fit(decay_model(), decay_runs(noise=0.0), CHANNEL)
    # the prior pulls: by (sd / prior sd)^2 prior widths, well below one sd
    for name, truth in (("rate", 0.8), ("omega", 6.5), ("offset@a", 0.05), ("offset@b", -0.08)):
        assert abs(found.values[name] - truth) < 0.5 * found.sd[name]
    assert not found.undetermined and not found.at_bound


def test_intervals_cover_the_truth():
    inside = []
    for seed in range(60):
        found = fit(decay_model(), decay_runs(seed=seed), CHANNEL)
        inside += [
            abs(found.values["rate"] - 0.8) < 1.645 * found.sd["rate"],
            abs(found.values["omega"] - 6.5) < 1.645 * found.sd["omega"],
        ]
    # 120 draws at 90 %: 108 +- 3.3; four sd either side
    assert 95 <= sum(inside) <= 120


@pytest.mark.parametrize("gradient", ["differences", "autograd"])
def test_lbfgs_agrees_with_gauss_newton(gradient):
    first = fit(decay_model(), decay_runs(), CHANNEL)
    second = fit(
        decay_model(), decay_runs(), CHANNEL, method="lbfgs", gradient=gradient, max_evaluations=200
    )
    assert second.converged
    np.testing.assert_allclose(second.x, first.x, atol=2e-3)  # gradients differ by step^2


@pytest.mark.grad
def test_differences_forward_mode_and_reverse_mode_agree():
    x = np.array([0.3, -0.4, 0.2, 0.1])
    problem = Problem(decay_model(), tuple(decay_runs()), WhiteNoise(CHANNEL))
    exact = Problem(
        problem.model, problem.runs, problem.whitener, jacobian=Jacobian(method="forward_mode")
    )
    r, a = problem.linearize(x)
    r2, a2 = exact.linearize(x)
    np.testing.assert_allclose(r, r2, atol=1e-12)
    np.testing.assert_allclose(a, a2, rtol=0, atol=1e-4 * np.abs(a2).max())  # step^2 / 6 ~ 2e-5
    cost, slope = problem.gradient(x)
    np.testing.assert_allclose(cost, 0.5 * r @ r)
    np.testing.assert_allclose(slope, -a2.T @ r, rtol=1e-9)


def test_nuisance_of_a_run_acts_in_that_run_only():
    problem = Problem(decay_model(), tuple(decay_runs()), WhiteNoise(CHANNEL))
    _, a = problem.linearize(np.zeros(4))
    half = len(a) // 2
    assert not a[half:, 2].any() and not a[:half, 3].any()
    assert a[:half, 2].all() and a[half:, 3].all()


@pytest.mark.reference
@pytest.mark.parametrize("method", ["differences", "forward_mode"])
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_slopes_at_a_bound_are_those_within(method, side):
    """Beyond a bound a parameter is cut: differences across it would see half of the slope."""
    plain, at = decay_model(), 0.8 if side == "upper" else -0.8
    x = np.array([at, 0.0, 0.0, 0.0])

    def slope(**bounds):
        base = [replace(p, **(bounds if p.name == "rate" else {})) for p in plain.base]
        model = SimModel(plain.build, base, batched=True)
        jacobian = Jacobian(method=method, step=1e-3)
        problem = Problem(model, decay_runs(), WhiteNoise(CHANNEL), (), jacobian)
        return problem.linearize(x)[1][:, 0]

    free, edge = slope(), 0.5 * np.exp(0.5 * at)
    near = edge + (1e-5 if side == "upper" else -1e-5)  # less than a step away
    for bound in (edge, near):
        np.testing.assert_allclose(slope(**{side: bound}), free, atol=1e-5 * np.abs(free).max())


def test_differences_go_no_farther_than_a_parameter_says():
    """An edge of the record that moves with the value is closer than a prior's width."""
    asked = []

    def build(values, run, numerics):
        asked.append(np.atleast_1d(values["omega"].detach().numpy()))
        return Decay(values, run)

    base = [
        replace(p, log=False, sd=2.0, step=1e-4 if p.name == "omega" else np.inf)
        for p in decay_model().base
    ]
    jacobian = Jacobian(method="differences", step=0.1)
    model = SimModel(build, base, batched=True)
    problem = Problem(model, decay_runs(), WhiteNoise(CHANNEL), (), jacobian)
    problem.linearize(np.zeros(4))
    reach = np.abs(np.concatenate(asked) - 6.0)
    assert reach.max() == pytest.approx(1e-4, rel=1e-6)


def test_bound_is_kept_and_stated():
    found = fit(decay_model(rate_upper=0.6), decay_runs(), CHANNEL)
    assert found.values["rate"] <= 0.6
    assert found.at_bound == ("rate",)


def test_unsigned_size_stays_at_zero_where_the_data_ask_for_less():
    push = linear.line("push", signed=False)
    runs = [linear.run("r1", 1)]

    shape = linear.shapes("push", runs[0]).numpy()[..., 0]
    from dataclasses import replace

    runs[0] = replace(runs[0], measured=runs[0].measured - 3.0 * shape)
    found = fit(linear.model(), runs, linear.CHANNELS, effects=(push,))
    assert found.values["push"] == 0.0
    assert "push" in found.at_bound


def test_missing_samples_are_left_out():
    runs = decay_runs()
    runs[0].measured[5:9] = np.nan
    found = fit(decay_model(), runs, CHANNEL)
    assert found.num_samples == 2 * len(TIME) - 4
    assert np.isfinite(found.chi2)


def test_stopping_early_is_stated():
    found = fit(decay_model(), decay_runs(), CHANNEL, max_evaluations=1)
    assert not found.converged


def test_errors_say_what_to_do():
    runs = decay_runs()
    with pytest.raises(ValueError, match="runs is empty"):
        fit(decay_model(), [], CHANNEL)
    with pytest.raises(ValueError, match="did you mean 'gauss_newton'"):
        fit(decay_model(), runs, CHANNEL, method="gauss-newton")
    with pytest.raises(ValueError, match="no sd; state it"):
        fit(decay_model(), runs, (Channel("x_m", "m", "position"),))
    with pytest.raises(ValueError, match=r"start must have shape \(4,\)"):
        fit(decay_model(), runs, CHANNEL, start=np.zeros(3))
    wrong = Run("a", TIME[:5], np.zeros((5, 2)), {}, "a")
    with pytest.raises(ValueError, match=r"predicts .* for run a"):
        fit(decay_model(), [wrong], (CHANNEL[0], CHANNEL[0]))


@pytest.mark.parametrize("far", [np.nan, 1e200])  # whose square is no number
def test_a_step_out_of_the_range_of_numbers_is_a_failed_step(far):
    """The simulator is not asked: it may refuse in its own way, which would end a search."""

    def refuse(values, run, numerics):
        raise ValueError("parameters must be finite")

    model = SimModel(refuse, decay_model().base)
    problem = Problem(model, tuple(decay_runs()), WhiteNoise(CHANNEL))
    with pytest.raises(PredictionError, match="left the range"):
        problem.residual(np.array([0.0, 0.0, far, 0.0]))


@pytest.mark.parametrize("batched", [True, False])
def test_a_table_costs_what_its_simulations_were_counted_as(batched):
    """Of four coordinates a run feels three: the other's offset costs it nothing."""
    runs = decay_runs()
    runs[1] = runs[1].part(slice(20))
    model = decay_model()
    model.batched = batched
    problem = Problem(model, tuple(runs), WhiteNoise(CHANNEL))
    points = 3.0
    each = 0.25 if batched else 1.0
    alone = problem.cost()
    assert problem.cost_of_table() == alone * (1.0 + each * 3.0)
    assert problem.cost_of_table(points) == alone * (1.0 + each * (points + 3.0))
    before = model.simulations.steps
    problem.linearize_record(np.zeros(4))  # central differences: two along each coordinate
    counted = model.simulations.steps - before
    wanted = problem.cost_of_table(each=2.0 * each)
    assert abs(counted - wanted) <= 2 * len(runs)  # each is rounded to whole steps
