from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats

from diffsim.diagnose import Unknown, UnknownDrift
from diffsim.diagnose.descend import Descended
from diffsim.diagnose.evidence import AMPLITUDES, Hypothesis, Linearisation, unrealised
from diffsim.diagnose.local import local_at
from diffsim.diagnose.search import Search
from diffsim.identify import fit
from tests.diagnose import linear


def constant(y):
    """What ``evidence`` leaves out."""
    return -0.5 * len(y) * np.log(2 * np.pi)


def linearised(problem, x, unknowns, num_families):
    """At x, with the responses of unknown causes."""
    responses = [u.responses(problem, x) for u in unknowns]
    return Linearisation(problem, x, *problem.linearise(x), responses, num_families)


@pytest.mark.reference
def test_signed_effects_against_the_marginal_normal():
    effects = (linear.Line("push"), linear.Line("wind", components=("x", "y")))
    lin = linearised(linear.problem(effects), np.zeros(5), (), 1)
    y, a = linear.matrices(effects)
    for members, columns in [
        ((), [0, 1]),
        ((0,), [0, 1, 2]),
        ((1,), [0, 1, 3, 4]),
        ((0, 1), [0, 1, 2, 3, 4]),
    ]:
        b = a[:, columns]
        truth = stats.multivariate_normal(cov=np.eye(len(y)) + b @ b.T).logpdf(y)
        found = lin.weigh(Hypothesis(frozenset(members))).nats + constant(y)
        np.testing.assert_allclose(found, truth, rtol=1e-9)


@pytest.mark.reference
@pytest.mark.parametrize("push", [-0.8, -0.1, 0.0, 0.3, 1.5])
def test_half_normal_against_a_brute_force_integral(push):
    """Over both base parameters analytically, over the size by quadrature."""
    effect = linear.Line("push", signed=False)
    y, a = linear.matrices((effect,))
    runs = []
    from dataclasses import replace

    for r in (linear.run("r1", 1), linear.run("r2", 2)):
        shape = linear.shapes("push", r).numpy()[..., 0]
        runs.append(replace(r, measured=r.measured + push * shape))
    y, a = linear.matrices((effect,), runs)
    base = stats.multivariate_normal(cov=np.eye(len(y)) + a[:, :2] @ a[:, :2].T)
    peak = max(
        base.logpdf(y - a[:, 2] * s) + stats.halfnorm.logpdf(s) for s in np.linspace(0, 5, 200)
    )
    area, _ = integrate.quad(
        lambda s: np.exp(base.logpdf(y - a[:, 2] * s) + stats.halfnorm.logpdf(s) - peak),
        0.0,
        8.0,
        epsabs=1e-10,
        limit=400,
        points=[0.01, 0.1, 0.5, 1.0, 2.0],
    )
    # linearised away from the answer: in a linear problem it must not matter
    lin = linearised(linear.problem((effect,), runs), np.array([0.3, -0.2, 0.7]), (), 1)
    found = lin.weigh(Hypothesis(frozenset({0}))).nats + constant(y)
    np.testing.assert_allclose(found, peak + np.log(area), rtol=1e-6)


class Given(Unknown):
    name = "given"

    def __init__(self, responses):
        self.h = responses

    def slopes(self, problem, x):
        return self.h

    def responses(self, problem, x):
        return self.h


@pytest.mark.reference
def test_unknown_against_the_marginal_normal_averaged_over_amplitudes():
    effects = (linear.Line("push"),)
    y, a = linear.matrices(effects)
    h = np.random.default_rng(0).normal(size=(len(y), 7))
    unit = h / np.sqrt(np.sum(h**2) / len(y))
    lin = linearised(linear.problem(effects), np.zeros(3), (Given(h),), 1)
    for members, columns in [((), [0, 1]), ((0,), [0, 1, 2])]:
        b = a[:, columns]
        logs = [
            stats.multivariate_normal(
                cov=np.eye(len(y)) + b @ b.T + amplitude**2 * unit @ unit.T
            ).logpdf(y)
            for amplitude in AMPLITUDES
        ]
        truth = np.log(np.mean(np.exp(logs)))
        found = lin.weigh(Hypothesis(frozenset(members), 0)).nats + constant(y)
        np.testing.assert_allclose(found, truth, rtol=1e-9)


def test_every_effect_and_unknown_pays_for_being_chosen():
    effects = (linear.Line("push"), linear.Line("pull"))
    h = np.random.default_rng(0).normal(size=(60, 3))
    cheap, dear = (linearised(linear.problem(effects), np.zeros(4), (Given(h),), n) for n in (1, 5))
    key = Hypothesis(frozenset({0, 1}), 0)
    np.testing.assert_allclose(cheap.weigh(key).nats - dear.weigh(key).nats, 3 * np.log(5))


def test_drift_moves_its_channel_only_and_alike_in_repeats():
    from dataclasses import replace

    runs = [linear.run("r1", 1), replace(linear.run("r2", 2), group="r1"), linear.run("r3", 3)]
    problem = linear.problem((), runs)
    h = (
        UnknownDrift(1, "drift")
        .responses(problem, np.zeros(2))
        .reshape(3, linear.NUM_SAMPLES, 2, -1)
    )
    assert not h[:, :, 0].any()
    np.testing.assert_array_equal(h[0], h[1])
    assert not (h[0].any(axis=(0, 1)) & h[2].any(axis=(0, 1))).any()
    assert h[2].any()


@pytest.mark.reference
def test_what_a_fit_left_unrealised_is_what_its_cost_lies_above_the_optimum():
    runs = (linear.run("r1", 1), linear.run("r2", 2))
    best = fit(linear.model(), runs, linear.CHANNELS)
    assert unrealised(best) == pytest.approx(0.0, abs=1e-6)

    def cost(x):
        return 0.5 * float(np.sum(best.problem.residual(x) ** 2) + x @ x)

    x = best.x + np.array([0.4, -0.3])
    stopped = replace(best, x=x, residual=best.problem.residual(x))
    assert unrealised(stopped) == pytest.approx(cost(x) - cost(best.x), rel=1e-6)


def test_the_search_does_not_credit_an_optimum_that_a_fit_has_not_found():
    effects = (linear.Line("push"),)
    problem = linear.problem(effects)
    found = fit(problem.model, problem.runs, linear.CHANNELS)
    moved = found.x + np.array([0.4, -0.3])
    nats = []
    for x in (found.x, moved):
        stopped = replace(found, x=x, residual=found.problem.residual(x))
        null = Descended(stopped, local_at(found.problem, x))
        nats.append(Search(problem, (), null).entries[Hypothesis()].nats)
    assert nats[0] - nats[1] == pytest.approx(unrealised(stopped), rel=1e-6)
