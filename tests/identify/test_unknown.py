"""Causes that nobody wrote down: the covariance of what they may add is the one they state."""

from __future__ import annotations

import numpy as np
import pytest

from diffsim.identify.unknown import UnknownDrift, UnknownLaw
from tests.diagnose import linear


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
