"""Base values, fitted starts and causes that nobody wrote down: each as it is stated."""

import numpy as np
import pytest
import torch
from scipy import sparse

from diffsim.identify import Parameter
from diffsim.identify.model import BaseValues
from diffsim.identify.starts import left_by_starts
from diffsim.identify.unknown import UnknownDrift, UnknownLaw
from tests.diagnose import linear

BASE = (
    Parameter("mass", 1.5, 0.1, "kg", log=True, lower=0.2),
    Parameter("zero", 0.0, 2.0, lower=-1.0, upper=3.0),
    Parameter("gain", 4.0, 0.3),
    Parameter("drag", 0.2, 1.0, log=True),
)


@pytest.mark.parametrize("shape", [(4,), (5, 4)])
def test_values_are_those_of_each_parameter(shape):
    q = torch.from_numpy(np.random.default_rng(0).normal(size=shape))
    at = BaseValues(BASE).at(q)
    assert list(at) == [p.name for p in BASE] and len(at) == 4
    for i, p in enumerate(BASE):
        assert p.name in at and torch.equal(at[p.name], p.value_at(q[..., i]))
    assert "speed" not in at and "speed" not in {**at}
    with pytest.raises(KeyError, match="speed"):
        at["speed"]


def test_a_slope_by_one_value_reaches_its_coordinate_alone():
    q = torch.zeros(4, dtype=torch.float64, requires_grad=True)
    (grad,) = torch.autograd.grad(BaseValues(BASE).at(q)["drag"], q)
    assert grad.tolist() == [0.0, 0.0, 0.0, 0.2]  # d exp(q) 0.2


def test_bounds_are_those_in_standardized_coordinates():
    values = BaseValues(BASE)
    assert values.low == pytest.approx([np.log(0.2 / 1.5) / 0.1, -0.5, -np.inf, -np.inf])
    assert values.high == pytest.approx([np.inf, 1.5, np.inf, np.inf])


def test_it_is_what_least_squares_leave_in_each_window():
    rng = np.random.default_rng(2)
    slopes = rng.normal(size=(3, 8, 2))
    fitted = np.linalg.pinv(slopes)
    change = rng.normal(size=(21, 4)) * (rng.random((21, 4)) < 0.5)  # the last window is cut
    left = left_by_starts(sparse.csr_array(change), *map(torch.from_numpy, (slopes, fitted)))
    padded = np.concatenate([change, np.zeros((3, 4))]).reshape(3, 8, 4)
    expected = [c - s @ np.linalg.lstsq(s, c)[0] for s, c in zip(slopes, padded, strict=True)]
    np.testing.assert_allclose(left.toarray(), np.concatenate(expected)[:21], atol=1e-12)


def covariance_of(unknown, problem):
    slopes = unknown.slopes(problem, np.zeros(3))
    shape = (*problem.runs[0].measured.shape, -1)
    of_channel = slopes.reshape(shape)[:, unknown.channel]
    others = np.delete(slopes.reshape(shape), unknown.channel, axis=1)
    assert not others.any()
    return of_channel @ of_channel.T


@pytest.mark.parametrize("channel", [0, 1])
def test_a_drift_begins_with_the_record(channel):
    """Two samples are alike by exp(-d^2 / 2 l^2), l two knots, from the first sample on."""
    problem = linear.problem([], (linear.run("r1", 1),))
    run = problem.runs[0]
    time = run.time_s - run.time_s[0]
    unknown = UnknownDrift(channel, "drift", num_knots=len(time))
    count = min(max(round(time[-1] * 5.0) + 1, 4), len(time))
    knots = np.linspace(0.0, time[-1], count)
    length = 2.0 * time[-1] / (count - 1)
    between = np.stack([np.interp(time, knots, e) for e in np.eye(count)], 1)
    stated = np.exp(-0.5 * ((knots[:, None] - knots) / length) ** 2)
    expected = between @ stated @ between.T
    np.testing.assert_allclose(covariance_of(unknown, problem), expected, atol=1e-6)


def test_a_law_spans_what_its_feature_does():
    """Its knots lie between the least and the greatest value, here 3 and 7."""
    problem = linear.problem([], (linear.run("r1", 1),))

    def feature(run):
        return np.linspace(3.0, 7.0, len(run.time_s))

    knots = np.linspace(3.0, 7.0, 8)
    between = np.stack([np.interp(feature(problem.runs[0]), knots, e) for e in np.eye(8)], 1)
    length = 2.0 * 4.0 / 7.0
    stated = np.exp(-0.5 * ((knots[:, None] - knots) / length) ** 2)
    got = covariance_of(UnknownLaw(0, "law", feature), problem)
    np.testing.assert_allclose(got, between @ stated @ between.T, atol=1e-6)
