"""Slopes of the posterior of spreads, and shares of normal distributions, by other means."""

import numpy as np
import pytest

from diffsim.diagnose.faults.evidence import positive_quadrant
from diffsim.diagnose.faults.given import take_apart
from diffsim.diagnose.faults.goals import rows_at
from diffsim.diagnose.faults.learn import log_posterior
from diffsim.diagnose.faults.local import problem_of
from diffsim.diagnose.faults.marginal import Priors, without
from diffsim.identify.problem import Problem
from diffsim.identify.whitening import WhiteNoise
from tests.diagnose.faults import days

STEP = 1e-4


def test_slopes_along_spreads_are_those_of_differences():
    rng = np.random.default_rng(3)
    runs = [r for k in range(4) for r in days.group(f"sound{k}", rng, {}, "sound")]
    runs += days.group("known", rng, {"first": 0.2}, "first")
    study = days.study(runs)
    setup = days.setup(study)
    given = take_apart(study, setup)
    problem = Problem(setup.model, study.runs, WhiteNoise(study.channels), setup.effects)
    effects = {e.name: e for e in problem.effects}
    point = np.zeros(len(problem.names))
    locals_ = {
        g.label: rows_at(
            problem_of(problem, g), given.layout, point, [effects[c] for c in g.known or ()]
        ).plain
        for g in given.groups
    }
    at = 0.4 * rng.standard_normal(len(given.layout.families))
    _, slopes = log_posterior(given.layout, locals_, at)
    for k, unit in enumerate(np.eye(len(at))):
        up, down = (
            log_posterior(given.layout, locals_, at + s * STEP * unit)[0] for s in (1.0, -1.0)
        )
        assert abs(slopes[k] - (up - down) / (2.0 * STEP)) < 1e-6 * max(abs(slopes[k]), 1.0)


@pytest.mark.parametrize("correlation", [-0.99, -0.3, 0.0, 0.8])
@pytest.mark.parametrize("mean", [(0.0, 0.0), (1.3, -0.4), (-2.0, -3.0), (4.0, 0.0), (0.0, -1.0)])
def test_the_share_of_a_quadrant_is_that_of_numerical_integration(mean, correlation):
    from scipy.stats import multivariate_normal

    covariance = np.array([[1.0, correlation], [correlation, 1.0]])
    share = multivariate_normal(cov=covariance, seed=0).cdf(np.array(mean))
    assert positive_quadrant(np.array(mean), correlation) == pytest.approx(share, abs=2e-8)


def test_what_is_integrated_out_leaves_the_marginal_of_each_draw():
    """Against the normal density of samples y = A z + B x + noise, z ~ N(mean, covariance)."""
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(1)
    a, b, y = rng.normal(size=(9, 3)), rng.normal(size=(9, 2)), rng.normal(size=9)
    means = rng.normal(size=(2, 3))
    roots = rng.normal(size=(2, 3, 3))
    covariances = roots @ roots.swapaxes(1, 2) + np.eye(3)
    both = np.column_stack([a, b])
    priors = Priors.of(np.linalg.inv(covariances), means)
    level = -0.5 * float(y @ y) - 4.5 * np.log(2.0 * np.pi)
    found = without(both.T @ both, both.T @ y, level, slice(0, 3), priors)
    for x in (np.zeros(2), np.array([0.7, -1.1])):
        for f, mean, covariance in zip(found, means, covariances, strict=True):
            truth = multivariate_normal(a @ mean + b @ x, a @ covariance @ a.T + np.eye(9))
            said = f.level + f.slope @ x - 0.5 * x @ f.curvature @ x
            assert said == pytest.approx(truth.logpdf(y), abs=1e-9)
