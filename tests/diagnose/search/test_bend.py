"""What Gauss-Newton leaves out is learned, and large misfits in bent valleys are fitted by it."""

from __future__ import annotations

import numpy as np

from diffsim.diagnose.search.gauss_newton import Point, definite, learned

RIGHT = np.array([1.0, 2.0])


def point(u):
    """y - S(u) with S = (u0, u1, 5 u0 u1, 20 + u0^2) and its slopes."""
    record = np.array([u[0], u[1], 5.0 * u[0] * u[1], 20.0 + u[0] ** 2])
    slopes = np.array([[1.0, 0.0], [0.0, 1.0], [5.0 * u[1], 5.0 * u[0]], [2.0 * u[0], 0.0]])
    return Point(np.array(u), np.array([*RIGHT, 10.0, 0.0]) - record, slopes)


def hessian_beyond(u):
    """- sum_i r_i d2S_i of half of |r|^2, by hand."""
    r = point(u).residual
    return -np.array([[2.0 * r[3], 5.0 * r[2]], [5.0 * r[2], 0.0]])


def test_the_bend_answers_along_the_last_step_as_slopes_do():
    before, here = point([0.3, 0.2]), point([0.32, 0.19])
    bend = learned(np.zeros((2, 2)), before, here)
    step = here.scaled - before.scaled
    assert np.allclose(bend, bend.T)
    assert np.allclose(bend @ step, (before.slopes - here.slopes).T @ here.residual)
    assert np.allclose(bend @ step, hessian_beyond(here.scaled) @ step, rtol=0.05)


def test_nothing_is_learned_where_the_gradient_stays():
    same = point([0.3, 0.2])
    before = Point(same.scaled - 0.1, same.residual, same.slopes)
    assert not learned(np.zeros((2, 2)), before, same).any()


def test_steps_lead_down_whatever_was_learned():
    gram = np.diag([4.0, 0.5])
    bend = np.array([[-30.0, 1.0], [1.0, 2.0]])
    total = definite(gram, bend) + np.eye(2)
    assert np.linalg.eigvalsh(total).min() >= 1.0 - 1e-12
    assert np.array_equal(definite(gram, np.zeros((2, 2))), gram)


def descended(with_bend, u=(2.5, 0.3), count=60):
    """Number of steps, of length 0.3 at most, until half of |r|^2 + |u|^2 is within 1e-6 of its
    least value along the way of the better method."""
    u, bend, before = np.array(u), np.zeros((2, 2)), None
    costs = []
    for _ in range(count):
        here = point(u)
        if before is not None and with_bend:
            bend = learned(bend, before, here)
        total = definite(here.slopes.T @ here.slopes, bend) + np.eye(2)
        step = np.linalg.solve(total, here.slopes.T @ here.residual - u)
        step *= min(1.0, 0.3 / np.abs(step).max())
        costs.append(0.5 * float(here.residual @ here.residual + u @ u))
        before, u = here, u + step
    return np.array(costs)


def test_a_large_misfit_is_fitted_in_fewer_steps():
    plain, bent = descended(with_bend=False), descended(with_bend=True)
    least = min(plain.min(), bent.min()) + 1e-6
    assert bent[-1] <= least
    assert np.argmax(bent <= least) < 0.7 * (np.argmax(plain <= least) or len(plain))
