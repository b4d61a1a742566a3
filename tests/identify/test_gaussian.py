"""The one Gaussian against dense algebra: covariances of samples, and least squares."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.identify.gaussian import Gaussian

N, COUNT = 40, 5


@pytest.fixture
def drawn():
    rng = np.random.default_rng(3)
    return rng.normal(size=(N, COUNT)), 2.0 * rng.normal(size=N), rng.normal(size=(N, 3))


@pytest.mark.reference
def test_evidence_mean_and_covariance_are_those_of_the_samples(drawn):
    j, r, _ = drawn
    made = Gaussian.of(j, r)
    dense = np.eye(N) + j @ j.T  # of the samples
    sign, log_det = np.linalg.slogdet(dense)
    assert sign == 1.0
    assert made.log_evidence == pytest.approx(-0.5 * (r @ np.linalg.solve(dense, r) + log_det))
    np.testing.assert_allclose(made.mean, j.T @ np.linalg.solve(dense, r), atol=1e-12)
    covariance = np.eye(COUNT) - j.T @ np.linalg.solve(dense, j)
    np.testing.assert_allclose(made.covariance, covariance, atol=1e-12)
    mean, spread = made.marginal([3, 1])
    np.testing.assert_allclose(mean, made.mean[[3, 1]])
    np.testing.assert_allclose(spread, covariance[np.ix_([3, 1], [3, 1])], atol=1e-12)


@pytest.mark.reference
def test_what_is_known_is_no_coordinate_any_more(drawn):
    j, r, _ = drawn
    values = np.array([0.7, -1.2])
    made, rest = Gaussian.of(j, r).given([1, 4], values), [0, 2, 3]
    known = Gaussian.of(j[:, rest], r - j[:, [1, 4]] @ values)
    np.testing.assert_allclose(made.mean, known.mean, atol=1e-12)
    assert made.log_evidence == pytest.approx(known.log_evidence)


@pytest.mark.reference
def test_parts_add_up_and_leave(drawn):
    j, r, _ = drawn
    first, last = Gaussian.of(j[:15], r[:15]), Gaussian.of(j[15:], r[15:])
    for made, (rows, seen) in (
        (first + last, (j, r)),
        (Gaussian.of(j, r).without(first), (j[15:], r[15:])),
    ):
        known = Gaussian.of(rows, seen)
        np.testing.assert_allclose(made.mean, known.mean, atol=1e-12)
        assert made.log_evidence == pytest.approx(known.log_evidence)
        assert made.num_samples == len(seen)


@pytest.mark.reference
def test_gain_of_columns_is_what_a_joint_fit_gains(drawn):
    j, r, d = drawn
    gram, score = Gaussian.of(j, r).gain(j.T @ d, d.T @ d, d.T @ r)

    def least(a):  # of |r - J x - D a|^2 + |x|^2 over x
        left = r - d @ a
        return left @ np.linalg.solve(np.eye(N) + j @ j.T, left)

    for a in np.random.default_rng(0).normal(size=(4, 3)):
        assert least(np.zeros(3)) - least(a) == pytest.approx(2.0 * a @ score - a @ gram @ a)


def test_no_coordinate_at_all():
    made = Gaussian.of(np.zeros((4, 0)), np.arange(4.0))
    assert made.log_evidence == -7.0 and made.mean.shape == (0,)
