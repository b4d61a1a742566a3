import numpy as np
import pytest

from diffsim.diagnose.search.evidence import VISIBLE, LaplaceEvidence, screen
from diffsim.identify import fit
from tests.diagnose import linear

EFFECTS = (linear.line("push"), linear.line("wind", components=("x", "y")), linear.line("pull"))


def screened(problem, x):
    return screen(LaplaceEvidence(problem, x, *problem.linearize(x), [], 1))


def at_null():
    null = fit(linear.model(), [linear.run("r1", 1), linear.run("r2", 2)], linear.CHANNELS)
    problem = linear.problem(EFFECTS)
    x = np.concatenate([null.x, np.zeros(4)])
    return null, screened(problem, x)


def refit_cost(columns):
    """(cost, sizes) with a prior on the base parameters only, by stacked least squares."""
    y, a = linear.matrices(EFFECTS)
    a = a[:, [0, 1, *columns]]
    stacked = np.vstack([a, np.eye(a.shape[1])[:2]])
    target = np.concatenate([y, np.zeros(2)])
    sizes, *_ = np.linalg.lstsq(stacked, target, rcond=None)
    return np.sum((target - stacked @ sizes) ** 2), sizes[2:]


@pytest.mark.reference
def test_z_and_size_against_refits():
    _, seen = at_null()
    null_cost, _ = refit_cost([])
    for k in range(4):
        cost, sizes = refit_cost([2 + k])
        np.testing.assert_allclose(seen.z[k] ** 2, null_cost - cost, rtol=1e-6)
        np.testing.assert_allclose(seen.size[k], 0.6 * sizes[0], rtol=1e-6)
    cost, _ = refit_cost([3, 4])
    np.testing.assert_allclose(seen.block_z[1] ** 2, null_cost - cost, rtol=1e-6)


@pytest.mark.reference
def test_smallest_visible_size_has_a_score_of_six():
    _, seen = at_null()
    _, a = linear.matrices(EFFECTS)
    for k in range(4):
        # noise-free data holding just that size: chi2 that the base parameters cannot remove
        clean = a[:, 2 + k] * seen.smallest_visible[k] / 0.6
        base = a[:, :2]
        left = clean @ clean - (base.T @ clean) @ np.linalg.solve(
            base.T @ base + np.eye(2), base.T @ clean
        )
        np.testing.assert_allclose(np.sqrt(left), VISIBLE, rtol=1e-6)


def test_slopes_that_are_rounding_tell_nothing():
    problem, x = linear.problem(EFFECTS), np.zeros(6)
    residual, slopes = problem.linearize(x)
    slopes[:, 3] = 1e-10 * np.random.default_rng(0).normal(size=len(slopes))
    seen = screen(LaplaceEvidence(problem, x, residual, slopes, [], 1))
    assert seen.smallest_visible[1] == np.inf and seen.z[1] == 0.0
    assert not seen.confounding[1].any() and seen.confounding[2].any()


def test_confounding_is_one_for_twins_and_blind_for_a_base_parameter():
    twins = (linear.line("push"), linear.line("push", typical=4.0))
    problem = linear.problem(twins)
    seen = screened(problem, np.zeros(4))
    np.testing.assert_allclose(np.abs(seen.confounding), 1.0, atol=1e-9)
    # an effect shaped like a base parameter is absorbed up to that one's prior
    absorbed = linear.problem((linear.line("mass"), linear.line("pull")))
    seen = screened(absorbed, np.zeros(4))
    assert seen.smallest_visible[0] > 4 * seen.smallest_visible[1]
