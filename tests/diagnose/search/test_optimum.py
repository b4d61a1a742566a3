"""Optimum of a quadratic misfit under the heavy-tailed prior, against general minimizers."""

import numpy as np
import pytest
from scipy import optimize

from diffsim.diagnose.search.optimum import (
    _bounded_least_squares,
    optimum,
    quadratic_optimum,
)


def drawn(seed):
    """Misfit |r - A v|^2 with columns of very different lengths, bounds, and what is a size."""
    rng = np.random.default_rng(seed)
    num_base, num_sizes = rng.integers(0, 6), rng.integers(1, 5)
    n = num_base + num_sizes
    columns = rng.normal(size=(20, n)) * 10.0 ** rng.uniform(-2, 3, n)
    right = columns @ (rng.normal(size=n) * 10.0 ** rng.uniform(-2, 2)) + rng.normal(size=20)
    sizes = np.arange(n) >= num_base
    low = np.where(sizes & (rng.random(n) < 0.5), 0.0, -np.inf)
    high = np.where(~sizes & (rng.random(n) < 0.3), 0.5, np.inf)
    return columns, right, low, high, sizes


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(40))
def test_no_minimizer_finds_a_lower_cost_nearby(seed):
    columns, right, low, high, sizes = drawn(seed)

    def cost(v):
        x = np.arcsinh(1.5 * v[sizes]) / 1.5
        left = right - columns @ v
        return float(left @ left + v[~sizes] @ v[~sizes] + x @ x)

    gram, b = columns.T @ columns, columns.T @ right
    v = optimum(gram, b, low, high, sizes, np.zeros(len(b)))
    assert (v >= low).all() and (v <= high).all()
    bounds = list(zip(low, high, strict=True))
    options = {"ftol": 1e-15, "gtol": 1e-10, "maxiter": 2000}
    nearby = optimize.minimize(cost, v, bounds=bounds, method="L-BFGS-B", options=options)
    assert cost(v) <= nearby.fun + 1e-5
    unpenalized = optimize.lsq_linear(columns, right, (low, high)).x
    for start in (np.clip(np.zeros(len(b)), low, high), unpenalized):
        assert cost(v) <= cost(start) + 1e-5


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(20))
def test_bounded_least_squares_is_that_of_scipy(seed):
    columns, right, low, high, _ = drawn(seed)
    hessian = columns.T @ columns + np.eye(len(low))
    found = quadratic_optimum(hessian, columns.T @ right, low, high)
    stacked = np.vstack([columns, np.eye(len(low))])
    target = np.concatenate([right, np.zeros(len(low))])
    truth = optimize.lsq_linear(stacked, target, (low, high), method="bvls", tol=1e-14).x
    np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("seed", range(20))
def test_where_the_bounded_optimum_is_looked_for_first_does_not_move_it(seed):
    columns, right, low, high, _ = drawn(seed)
    hessian, b = columns.T @ columns + np.eye(len(low)), columns.T @ right
    low, high = np.maximum(low, -1.0), np.minimum(high, 1.0)
    alone = quadratic_optimum(hessian, b, low, high)
    for near in (low, high, np.where(np.arange(len(low)) % 2, low, high), np.zeros(len(low))):
        found = quadratic_optimum(hessian, b, low, high, near)
        np.testing.assert_allclose(found, alone, rtol=1e-9, atol=1e-12)


def test_where_active_sets_go_round_the_answer_is_the_same():
    """What rounding has left indefinite has an answer, too."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, 8))
        columns = rng.normal(size=(2 * n, n)) * 10 ** rng.uniform(-2, 2, n)
        hessian, b = columns.T @ columns + np.eye(n), columns.T @ rng.normal(size=2 * n)
        low, high = -(10 ** rng.uniform(-3, 1, n)), 10 ** rng.uniform(-3, 1, n)
        want = quadratic_optimum(hessian, b, low, high)
        found = _bounded_least_squares(hessian, b, low, high)
        costs = [v @ hessian @ v - 2.0 * b @ v for v in (want, found)]
        assert costs[1] - costs[0] < 1e-7 * (1.0 + abs(costs[0]))
    same = np.array([1.0, 1e6, 1e-3])
    flat = np.outer(same, same) - np.diag([1e-16, 1e-4, 0.0])  # less than none along two ways
    found = _bounded_least_squares(flat, same, -np.ones(3), np.ones(3))
    assert np.isfinite(found).all() and float(same @ found) == pytest.approx(1.0, abs=1e-6)
