"""The one Gaussian against dense algebra that it was not written from."""

import numpy as np
import pytest

from diffsim.identify.gaussian import Gaussian

RNG = np.random.default_rng(7)
SLOPES, MORE = RNG.normal(size=(30, 4)), RNG.normal(size=(30, 3))
RESIDUAL, POINT = RNG.normal(size=30), RNG.normal(size=4)


def log_density(residual, slopes, x, v):
    """Of a step from a point of coordinates that are N(0, 1), without powers of 2 pi."""
    left, at = residual - slopes @ v, x + v
    return -0.5 * float(left @ left + at @ at)


@pytest.mark.reference
def test_evidence_is_the_density_of_the_record():
    """With the coordinates integrated out the record is N(0, 1 + J J'), from any point."""
    covariance = np.eye(30) + SLOPES @ SLOPES.T
    there = -0.5 * RESIDUAL @ np.linalg.inv(covariance) @ RESIDUAL
    there -= 0.5 * np.linalg.slogdet(covariance)[1]
    assert Gaussian.of(SLOPES, RESIDUAL).nats == pytest.approx(there, rel=1e-12)
    moved = Gaussian.of(SLOPES, RESIDUAL - SLOPES @ POINT, POINT)
    assert moved.nats == pytest.approx(there, rel=1e-12)
    np.testing.assert_allclose(POINT + moved.mean, Gaussian.of(SLOPES, RESIDUAL).mean, rtol=1e-11)


@pytest.mark.reference
def test_it_is_the_density_that_it_was_made_of():
    at = Gaussian.of(SLOPES, RESIDUAL, POINT)
    for v in RNG.normal(size=(3, 4)):
        told = at.level + at.slope @ v - 0.5 * v @ at.curvature @ v
        assert told == pytest.approx(log_density(RESIDUAL, SLOPES, POINT, v), rel=1e-12)
    np.testing.assert_allclose(at.covariance, np.linalg.inv(SLOPES.T @ SLOPES + np.eye(4)))
    root = at.whitened(np.eye(4))
    np.testing.assert_allclose(root.T @ root, at.covariance, rtol=1e-10)


@pytest.mark.reference
def test_known_coordinates_leave_the_density_of_the_others():
    at, known = Gaussian.of(SLOPES, RESIDUAL, POINT), np.array([0.3, -0.7])
    rest = at.given([2, 0], known)
    for own in RNG.normal(size=(3, 2)):
        v = np.array([known[1], own[0], known[0], own[1]])
        told = rest.level + rest.slope @ own - 0.5 * own @ rest.curvature @ own
        assert told == pytest.approx(log_density(RESIDUAL, SLOPES, POINT, v), rel=1e-12)


@pytest.mark.reference
def test_further_columns_see_what_a_refit_leaves():
    """Their parabola is that of the record in the metric of 1 + J J', in which J is noise."""
    known = Gaussian.of(SLOPES, RESIDUAL)
    gram, slope = known.left_to(SLOPES.T @ MORE, MORE.T @ MORE, MORE.T @ RESIDUAL)
    metric = np.linalg.inv(np.eye(30) + SLOPES @ SLOPES.T)
    np.testing.assert_allclose(gram, MORE.T @ metric @ MORE, rtol=1e-11)
    np.testing.assert_allclose(slope, MORE.T @ metric @ RESIDUAL, rtol=1e-10)
    # both at once
    every = Gaussian.of(np.hstack([SLOPES, MORE]), RESIDUAL)
    left = -0.5 * float(RESIDUAL @ metric @ RESIDUAL)
    beside = Gaussian(gram + np.eye(3), slope, left).nats
    assert every.nats == pytest.approx(beside + known.nats - left, rel=1e-12)


@pytest.mark.reference
def test_what_is_taken_up_is_a_least_squares_fit_with_priors_as_rows():
    rows, none = np.vstack([SLOPES, np.eye(4)]), np.zeros((4, 3))
    fitted = np.linalg.lstsq(rows, np.vstack([MORE, none]), rcond=None)[0]
    np.testing.assert_allclose(Gaussian.of(SLOPES, RESIDUAL).solve(SLOPES.T @ MORE), fitted)
    np.testing.assert_allclose(Gaussian.of(SLOPES, MORE[:, 0]).mean, fitted[:, 0], rtol=1e-11)


def test_no_coordinates_take_up_nothing():
    none = np.zeros((30, 0))
    at = Gaussian.of(none, RESIDUAL)
    assert at.solve(none.T @ MORE).shape == (0, 3)
    assert at.nats == pytest.approx(-0.5 * float(RESIDUAL @ RESIDUAL))
    gram, slope = at.left_to(np.zeros((0, 3)), MORE.T @ MORE, MORE.T @ RESIDUAL)
    np.testing.assert_array_equal(gram, MORE.T @ MORE)
    np.testing.assert_array_equal(slope, MORE.T @ RESIDUAL)
