"""Sizes have heavy tails; what is exact in their standardized coordinates stays so."""

import numpy as np
import pytest
import torch
from scipy import integrate

from diffsim.identify import fit
from diffsim.identify.effect import coordinate_of, precision_at, scaled_at, stretch_at
from tests.diagnose import linear

X = np.linspace(-4.0, 4.0, 81)


def test_coordinate_and_size_are_inverse_and_monotone():
    u = scaled_at(X)
    np.testing.assert_allclose(coordinate_of(u), X, atol=1e-12)
    assert (np.diff(u) > 0.0).all() and scaled_at(np.zeros(1))[0] == 0.0
    slope = (scaled_at(X + 1e-6) - scaled_at(X - 1e-6)) / 2e-6
    np.testing.assert_allclose(stretch_at(X), slope, rtol=1e-8)
    assert stretch_at(np.zeros(1))[0] == 1.0
    np.testing.assert_allclose(scaled_at(torch.from_numpy(X)).numpy(), u, rtol=1e-14)


@pytest.mark.reference
def test_ten_times_the_typical_size_costs_two_nats():
    """And the density of sizes is one: the change of variables is complete."""
    from scipy import stats

    effect = linear.line("push", typical=0.4)
    problem = linear.problem((effect,))
    x = float(coordinate_of(np.array(10.0 / 1.5)))
    sizes = problem.sizes_at(torch.tensor([0.0, 0.0, x], dtype=torch.float64))
    assert float(sizes[effect][0]) == pytest.approx(4.0)
    assert 0.5 * x * x == pytest.approx(2.0, abs=0.05)

    def density(u):
        x = coordinate_of(np.array(u))
        return float(stats.norm.pdf(x) / stretch_at(x))

    assert integrate.quad(density, -1e3, 1e3, limit=400, points=[0.0])[0] == pytest.approx(
        1, abs=1e-3
    )
    beyond = integrate.quad(density, 10.0 / 1.5, 1e4, limit=400)[0]
    assert beyond == pytest.approx(stats.norm.sf(x), abs=1e-6)


def test_the_normal_stand_in_lies_above_the_prior_and_touches_it():
    for u in scaled_at(np.array([0.0, 0.3, -1.2, 2.5])):
        w = precision_at(np.array([u]))[0]
        gap = 0.5 * w * scaled_at(X) ** 2 - 0.5 * X**2
        touch = 0.5 * w * u**2 - 0.5 * coordinate_of(np.array([u]))[0] ** 2
        assert gap.min() >= touch - 1e-12


@pytest.mark.reference
def test_slopes_of_a_large_size_are_the_chain_rule_times_those_of_a_small_one():
    """Linear in the size: differences along it are exact wherever they are taken."""
    effect = linear.line("push")
    problem = linear.problem((effect,))
    _, near = problem.linearize(np.zeros(3))
    x = np.array([0.0, 0.0, 2.5])
    _, far = problem.linearize(x)
    np.testing.assert_allclose(far[:, 2], near[:, 2] * np.cosh(1.5 * 2.5), rtol=1e-10)
    _, scaled = problem.linearize_scaled(x)
    np.testing.assert_allclose(scaled, near, atol=1e-10)
    np.testing.assert_allclose(problem.standardized(problem.scaled(x)), x, rtol=1e-14)


@pytest.mark.reference
def test_the_sd_of_a_fitted_size_is_that_of_least_squares():
    from dataclasses import replace

    effect = linear.line("push", typical=0.4)
    runs = [
        replace(r, measured=r.measured + 4.0 * linear.shapes("push", r).numpy()[..., 0])
        for r in (linear.run("r1", 1), linear.run("r2", 2))
    ]
    found = fit(linear.model(), runs, linear.CHANNELS, effects=(effect,))
    y, a = linear.matrices((effect,), runs)
    prior = np.diag([1.0, 1.0, 0.0])  # flat for the size: at ten typical ones it hardly matters
    covariance = np.linalg.inv(a.T @ a + prior)
    assert found.sd["push"] == pytest.approx(0.6 * np.sqrt(covariance[2, 2]), rel=0.01)
    size = 0.6 * (covariance @ a.T @ y)[2]
    assert found.values["push"] == pytest.approx(size, abs=0.2 * found.sd["push"])
