"""Intervals along what the data do not tell, from slopes that are wrong by a percent."""

import numpy as np
import pytest
import torch

from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.diagnose.search.search import _fitted_along_weak
from diffsim.diagnose.search.simulations import Simulations
from diffsim.diagnose.search.weak_slopes import descended, mended, stepped
from diffsim.identify import Parameter, Problem, SimModel, WhiteNoise
from diffsim.identify.fitting import posterior_covariance
from diffsim.identify.linearization import linearization_at
from diffsim.identify.problem import PredictionError
from tests.diagnose import linear

STRONG = 1000.0  # noise sd that a prior sd of the difference moves
EDGE = 0.05  # prior sd from edge to edge, 2.5 times the width of differences


def problem_of(edges: float, low: float = -np.inf) -> Problem:
    """A record of u - v and, weakly, of w; in u it bends elsewhere, at edges, by a share."""
    run = linear.run("r1", 1)
    shape = linear.shapes("across", run)[..., 0]
    other, third = (linear.shapes(name, run)[..., 0] for name in ("along", "bends"))
    size = STRONG / float(np.linalg.norm(shape.numpy() / [c.sd for c in linear.CHANNELS]))

    def build(values, run, numerics):
        u, v, w = (values[n] for n in "uvw")
        bend = (torch.remainder(u, EDGE) - 0.5 * EDGE).abs() - 0.25 * EDGE
        return linear.LinearScene(
            size * ((u - v) * shape + edges * bend * third + 0.002 * w * other)
        )

    base = [Parameter(n, 0.013 * (n == "u"), 1.0, "m", lower=low) for n in "uvw"]
    return Problem(SimModel(build, base, "edges"), (run,), WhiteNoise(linear.CHANNELS), ())


def sd_of(problem, at):
    slopes = problem.whiten_all(at.columns) * problem.stretch(at.x)
    return np.sqrt(np.diag(posterior_covariance(slopes)))


def test_what_cancels_in_the_record_is_as_uncertain_as_its_priors_say():
    problem = problem_of(edges=0.01)
    at = linearization_at(problem, np.zeros(3))
    better = mended(problem, at)
    # u and v are known by their priors alone, which share their difference
    assert sd_of(problem, at)[:2].max() < 0.2
    np.testing.assert_allclose(sd_of(problem, better)[:2], np.sqrt(0.5), rtol=0.05)
    np.testing.assert_array_equal(better.record, at.record)
    # what the data tell stays told: the difference, and w beside it
    slopes = problem.whiten_all(better.columns)
    correlation = posterior_covariance(slopes)[0, 1] / sd_of(problem, better)[:2].prod()
    assert correlation == pytest.approx(1.0, abs=1e-4)
    exact = linearization_at(problem_of(edges=0.0), np.zeros(3))
    assert sd_of(problem, better)[2] == pytest.approx(sd_of(problem, exact)[2], rel=0.05)


def test_what_the_data_do_not_tell_goes_back_to_its_data_sheets():
    """A table's torque constant stood 14 prior sd off, though any scale leaves the same misfit."""
    problem = problem_of(edges=0.01)
    at = linearization_at(problem, np.array([6.0, 6.0, 0.0]))
    end = descended(problem, at)
    assert np.abs(end.x[:2]).max() < 0.1
    misfit = [float(np.sum(problem.residual_of(one.record) ** 2)) for one in (at, end)]
    assert misfit[1] == pytest.approx(misfit[0], rel=0.05)
    np.testing.assert_allclose(sd_of(problem, end)[:2], np.sqrt(0.5), rtol=0.05)
    right = linearization_at(problem_of(edges=0.0), np.array([6.0, 6.0, 0.0]))
    assert descended(problem_of(edges=0.0), right) is right  # a fit goes on by itself


def test_slopes_that_are_right_stay_the_same_object():
    problem = problem_of(edges=0.0)
    at = linearization_at(problem, np.zeros(3))
    assert mended(problem, at) is at


def test_where_bounds_leave_no_step_slopes_stay():
    problem = problem_of(edges=0.01, low=0.0)
    at = linearization_at(problem, np.zeros(3))
    assert mended(problem, at) is at
    away = linearization_at(problem, np.full(3, 5.0))  # room on both sides
    assert mended(problem, away) is not away


def test_a_full_step_along_weak_directions_leads_back_to_the_data_sheets():
    """A servo's weight stood 5 prior sd off, as all its forces may be larger by one factor: shares
    of a step cost more in a curved valley, and a fit stayed where it was."""
    problem = problem_of(edges=0.01)
    at = mended(problem, linearization_at(problem, np.array([6.0, 6.0, 0.0])))
    point = stepped(problem, at)
    assert point is not None and np.abs(point[:2]).max() < 0.1


def test_a_step_to_where_nothing_can_be_simulated_leads_nowhere(monkeypatch):
    """It ended the answer of a motor's test bench with an error of one run's prediction."""
    problem = problem_of(edges=0.01)
    at = linearization_at(problem, np.array([6.0, 6.0, 0.0]))
    made = Simulations(problem).kept(frozenset(), at)
    record = Problem.linearize_record

    def fails(self, x, **options):
        if np.abs(x).max() < 1.0:
            raise PredictionError("the prediction of run r1 has 117 NaN or infinite entries")
        return record(self, x, **options)

    monkeypatch.setattr(Problem, "linearize_record", fails)
    kept, start = made.along_weak(frozenset())
    assert start is None and kept.x[0] == 6.0


def test_a_finding_rests_on_slopes_that_are_right():
    """Of a right sheet an answer said: weight is 1.11 to 1.19 N m, the data sheet says 0.88."""
    sd = []
    for far in (3.0, 4.0, 5.0, 6.0, 8.0, 12.0):
        problem = problem_of(edges=0.01)
        start = linearization_at(problem, np.array([far, far, 0.0]))
        fit, at = gauss_newton(problem, start, until=-1.0)  # no step: it was held there
        assert np.sqrt(np.diag(fit.covariance))[:2].max() < 0.1 * far, "slopes hold it off"
        made = Simulations(problem).kept(frozenset(), at)
        _, after = _fitted_along_weak(made, frozenset(), fit, np.inf)
        assert np.abs(after.x[:2]).max() < 0.1 * far
        assert after.chi2 + after.prior < fit.chi2 + fit.prior - 1.0
        sd.append(np.sqrt(np.diag(after.covariance))[:2])
    np.testing.assert_allclose(np.median(sd, 0), np.sqrt(0.5), rtol=0.05)
