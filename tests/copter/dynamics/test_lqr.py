"""Lyapunov and Riccati layers: other solvers, published gains, derivatives, named failures."""

import importlib.util

import numpy as np
import pytest
import scipy.linalg
import torch

from diffsim.copter import LQR, RiccatiError, hover, linearize, lqr, lqr_stats, lyapunov
from diffsim.copter.dynamics import _ops_riccati
from tests.copter.designs import random_copter
from tests.copter.vehicle.test_vehicle import NAMES, from_reference, reference
from tests.helpers import check_layer, with_derivatives


def eye(n):
    return torch.eye(n, dtype=torch.float64)


def system(seed, n=5, m=2):
    rng = np.random.default_rng(seed)
    make = lambda *shape: torch.from_numpy(rng.standard_normal(shape))  # noqa: E731
    root_q, root_r = make(n, n), make(m, m)
    return make(n, n), make(n, m), root_q @ root_q.T, root_r @ root_r.T + eye(m)


def scipy_lqr(A, B, Q, R):
    P = scipy.linalg.solve_continuous_are(*(t.numpy() for t in (A, B, Q, R)))
    return np.linalg.solve(R.numpy(), B.numpy().T @ P), P


def of_copter(copter):
    result = hover(copter)
    model = linearize(copter, result.thrusts, result.attitude)
    return *model, 10.0 * eye(12), eye(copter.num_rotors)


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_gain_of_public_tool(name):
    facts = reference(name)
    problem = of_copter(from_reference(facts))
    K, P = lqr(*problem)
    expected = torch.tensor(facts["K"], dtype=torch.float64)
    # the reference and scipy differ by 8e-11 themselves (its README)
    torch.testing.assert_close(K, expected, atol=1e-9, rtol=0)
    K_scipy, P_scipy = scipy_lqr(*problem)
    np.testing.assert_allclose(K, K_scipy, atol=1e-10)
    np.testing.assert_allclose(P, P_scipy, atol=1e-10 * np.abs(P_scipy).max())
    poles = np.sort(np.linalg.eigvals(problem[0] - problem[1] @ K).real)
    np.testing.assert_allclose(poles, np.sort(facts["closed_loop_eig_real_sorted"]), atol=1e-8)
    stats = lqr_stats(*problem)
    assert float(stats.residual) < 4e-15
    assert int(stats.num_iters) <= 10


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(20))
def test_same_as_scipy(seed):
    problem = system(seed, n=3 + seed % 8, m=2 + seed % 3)
    K, P = lqr(*problem)
    K_scipy, P_scipy = scipy_lqr(*problem)
    # both are backward stable; the worst of these is conditioned to 1e4
    np.testing.assert_allclose(P, P_scipy, atol=1e-10 * np.abs(P_scipy).max())
    np.testing.assert_allclose(K, K_scipy, atol=1e-10 * np.abs(K_scipy).max())


@pytest.mark.reference
@pytest.mark.skipif(importlib.util.find_spec("control") is None, reason="control is not installed")
def test_same_as_control():
    import control

    problem = of_copter(random_copter(1))
    K, P, _ = control.lqr(*(t.numpy() for t in problem))
    ours = lqr(*problem)
    np.testing.assert_allclose(ours.K, K, atol=1e-10 * np.abs(K).max())
    np.testing.assert_allclose(ours.P, P, atol=1e-10 * np.abs(P).max())


@pytest.mark.reference
def test_double_integrator():
    """x'' = u with Q = I, R = 1: K = (1, sqrt 3)."""
    A = torch.tensor([[0.0, 1.0], [0.0, 0.0]], dtype=torch.float64)
    B = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    root = 3.0**0.5
    K, P = lqr(A, B, eye(2), eye(1))
    expected = torch.tensor([[1.0, root]], dtype=torch.float64)
    torch.testing.assert_close(K, expected, atol=1e-14, rtol=0)
    expected = torch.tensor([[root, 1.0], [1.0, root]], dtype=torch.float64)
    torch.testing.assert_close(P, expected, atol=1e-14, rtol=0)


@pytest.mark.property
def test_cost_of_a_trajectory():
    """x' P x is the integral of the cost along the closed loop."""
    A, B, Q, R = of_copter(random_copter(2))
    K, P = lqr(A, B, Q, R)
    closed, running = A - B @ K, Q + K.T @ R @ K
    dt, x = 2e-3, torch.linspace(-1.0, 1.0, 12, dtype=torch.float64)
    start, step = x, torch.linalg.matrix_exp(closed * dt)
    costs = []
    for _ in range(int(40.0 / dt)):
        costs.append(float(x @ running @ x))
        x = step @ x
    assert float(x.norm()) < 1e-6
    assert np.trapezoid(costs, dx=dt) == pytest.approx(float(start @ P @ start), rel=2e-4)


@pytest.mark.property
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_badly_scaled_states(scale):
    """The same problem in other units of half the states gives the same gain, to rounding.

    Without balancing this fails for 1e-6.
    """
    A, B, Q, R = of_copter(random_copter(3))
    K, _ = lqr(A, B, Q, R)
    units = torch.ones(12, dtype=torch.float64)
    units[[3, 4, 5, 9, 10, 11]] = scale
    D, D_inv = torch.diag(units), torch.diag(1.0 / units)
    K_scaled, _ = lqr(D @ A @ D_inv, D @ B, D_inv @ Q @ D_inv, R)
    torch.testing.assert_close(K_scaled @ D, K, atol=1e-6 * float(K.abs().max()), rtol=0)


@pytest.mark.grad
def test_lqr_contract():
    A, B, Q, R = system(0, n=4)
    A = A - 2.0 * eye(4)  # else P is conditioned to 1e3 and differences lose as much
    args = [t.clone().requires_grad_() for t in (A, B, Q, R)]
    args[0] = A.T.contiguous().requires_grad_().T.detach().requires_grad_()  # strided
    assert not args[0].is_contiguous()

    def layer(A, B, Q, R):
        # only symmetric weights are weights: gradcheck moves single entries
        K, P = lqr(A, B, 0.5 * (Q + Q.mT), 0.5 * (R + R.mT))
        return torch.cat([K.flatten(), P.flatten()])

    G = B @ torch.linalg.solve(R, B.T)
    check_layer(
        layer,
        args,
        ops=with_derivatives(_ops_riccati.care, A[None], G[None], Q[None], 1),
        atol=1e-7,
        rtol=1e-7,
    )
    assert torch.autograd.gradgradcheck(layer, args, atol=1e-4, rtol=1e-5)


@pytest.mark.grad
def test_gradient_by_central_differences_of_fourth_order():
    """To 1e-8 on the hover model of a copter, whose four integrator chains sit at zero."""
    A, B, Q, R = of_copter(random_copter(4))
    rng = np.random.default_rng(0)
    moves = [torch.from_numpy(rng.standard_normal(t.shape)) for t in (A, B, Q, R)]
    moves[2], moves[3] = moves[2] + moves[2].T, 0.1 * (moves[3] + moves[3].T)
    cotangents = [torch.from_numpy(rng.standard_normal(s)) for s in ((6, 12), (12, 12))]

    def loss(h):
        moved = [t + h * m for t, m in zip((A, B, Q, R), moves, strict=True)]
        return sum((c * out).sum() for c, out in zip(cotangents, lqr(*moved), strict=True))

    h = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(h), h)
    e = 1e-3
    numeric = (8 * (loss(e) - loss(-e)) - (loss(2 * e) - loss(-2 * e))) / (12 * e)
    # truncation e^4, rounding 1e-15 * P / e
    assert float(slope) == pytest.approx(float(numeric), rel=1e-8)


@pytest.mark.grad
def test_lyapunov_contract():
    A, _, Q, _ = system(1)
    A = A - 4.0 * eye(5)
    Q = Q + torch.linspace(0, 1, 25, dtype=torch.float64).reshape(5, 5)  # not symmetric
    X = lyapunov(A, Q)
    np.testing.assert_allclose(X, scipy.linalg.solve_continuous_lyapunov(A, -Q), atol=1e-13)
    torch.testing.assert_close(A @ X + X @ A.T, -Q, atol=1e-13, rtol=0)
    args = [A.clone().requires_grad_(), Q.clone().requires_grad_()]
    ops = with_derivatives(_ops_riccati.lyapunov, A[None], Q[None], 1)
    check_layer(lyapunov, args, ops=ops, atol=1e-8, rtol=1e-7)
    assert torch.autograd.gradgradcheck(lyapunov, args)


def test_module_learns_weights():
    A, B, _, _ = of_copter(random_copter(0))
    wanted = lqr(A, B, 3.0 * eye(12), 2.0 * eye(6)).K
    ones = torch.ones(12, dtype=torch.float64)
    layer = LQR(ones, ones[:6])
    optimizer = torch.optim.LBFGS(layer.parameters(), max_iter=60, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        loss = (layer(A, B).K - wanted).square().sum()
        loss.backward()
        return loss

    first = float(closure().detach())
    optimizer.step(closure)
    assert float(closure().detach()) < 1e-6 * first
    assert not LQR(ones, ones[:6], trainable=False).log_q.requires_grad


def test_unstable_mode_that_no_input_moves():
    A = torch.diag(torch.tensor([-1.0, 2.0, 3.0], dtype=torch.float64))
    B = torch.tensor([[1.0], [0.0], [1.0]], dtype=torch.float64)
    with pytest.raises(RiccatiError, match=r"not stabilizable.*eigenvalue 2.*states 1 \(1") as err:
        lqr(A, B, eye(3), eye(1))
    assert err.value.reason == "not_stabilizable"
    assert err.value.eigenvalue == pytest.approx(2.0)
    assert abs(err.value.mode[1]) == pytest.approx(1.0)
    decaying = torch.diag(torch.tensor([-1.0, -2.0, 3.0], dtype=torch.float64))
    assert float(lqr_stats(decaying, B, eye(3), eye(1)).abscissa) < 0.0


def test_rotors_in_a_line_are_not_stabilizable():
    copter = random_copter(0, n=4, tilt=0.0)
    line = torch.zeros(4, 3, dtype=torch.float64)
    line[:, 0] = torch.tensor([-0.3, -0.1, 0.1, 0.3])
    copter = copter.replace(
        positions=line,
        inertia=torch.diag(torch.tensor([0.02, 0.025, 0.04], dtype=torch.float64)),
        torque_ratios=torch.full((4,), 0.015, dtype=torch.float64),
    )
    level = torch.zeros(2, dtype=torch.float64)
    thrusts = torch.full((4,), float(copter.weight) / 4, dtype=torch.float64)
    A, B = linearize(copter, thrusts, level)
    with pytest.raises(RiccatiError, match=r"not stabilizable") as err:
        lqr(A, B, 10.0 * eye(12), eye(4))
    # sideways motion, roll and roll rate
    assert np.square(np.abs(err.value.mode[[1, 3, 7, 9]])).sum() == pytest.approx(1.0)


def test_mode_that_the_weights_do_not_see():
    A, B, Q, R = of_copter(random_copter(0))
    Q[0, 0] = 0.0
    with pytest.raises(RiccatiError, match=r"undetectable.*states 0") as err:
        lqr(A, B, Q, R)
    assert err.value.reason == "undetectable"
    stacked = torch.stack([Q + 1e-3 * eye(12), Q])
    with pytest.raises(RiccatiError, match=r"batch entry 1"):
        lqr(A, B, stacked, R)


def test_lyapunov_without_solution():
    A = torch.diag(torch.tensor([1.0, -1.0, 2.0], dtype=torch.float64))
    with pytest.raises(RiccatiError, match=r"add up to zero"):
        lyapunov(A, eye(3))


@pytest.mark.parametrize(
    ("which", "value", "message"),
    [
        (1, torch.ones(4, 2, dtype=torch.float64), "B must have shape"),
        (2, -eye(5), "Q must be positive semidefinite, got smallest eigenvalue -1"),
        (2, torch.triu(torch.ones(5, 5, dtype=torch.float64)), "Q must be symmetric"),
        (3, 0.0 * eye(2), "R must be positive definite, got smallest eigenvalue 0"),
    ],
)
def test_bad_input(which, value, message):
    problem = list(system(0))
    problem[which] = value
    with pytest.raises(ValueError, match=message):
        lqr(*problem)
