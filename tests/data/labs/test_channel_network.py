"""The channel network against linear algebra, quadrature and conservation of mass."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from diffsim.data.labs import NetworkLab
from diffsim.data.labs.channel_network import DEPTH_M, LENGTH_M, WIDTH_M, _Network
from tests.data.labs.truths import exact

pytestmark = pytest.mark.reference
PUMP = 8e-9


@pytest.fixture(scope="module")
def lab():
    return NetworkLab()


def network(lab, **effects):
    return _Network(exact(lab, {}, **effects))


def steady(lab, back=0.0, **effects):
    return network(lab, **effects).steady(PUMP, back, np.zeros(2))[0]


def test_plain_network_against_a_linear_solve(lab):
    g = DEPTH_M * WIDTH_M**3 / (12 * 1e-3 * LENGTH_M)
    back = 7.0
    matrix = np.array([[g[1] + g[2], -g[1]], [-g[1], g[1] + g[3] + g[4]]])
    p = np.linalg.solve(matrix, [PUMP + g[2] * back, 0.0])
    expected = [g[2] * (p[0] - back), g[3] * p[1], g[4] * p[1], p[0] + PUMP / g[0], p[0]]
    np.testing.assert_allclose(steady(lab, back), expected, rtol=1e-8)


def test_mass(lab):
    for name in ("slip", "compliance", "thinning", "inertia", "blocked_branch", "cracking"):
        out = steady(lab, **{name: lab.effects[name].typical, **_filled(lab, name)})
        assert out[:3].sum() == pytest.approx(PUMP, rel=1e-8)
    out = steady(lab, leak=1e-11)
    assert PUMP - out[:3].sum() == pytest.approx(1e-11 * out[4], rel=1e-6)


def _filled(lab, name):
    n = lab.effects[name].components
    return {} if n == 1 else {name: (lab.effects[name].typical, *[0.0] * (n - 1))}


def test_viscosity_is_seen_by_pressure_only(lab):
    np.testing.assert_allclose(
        steady(lab, viscosity=0.1) / steady(lab), [1, 1, 1, 1.1, 1.1], rtol=1e-8
    )


def test_slip_against_the_velocity_profile(lab):
    b, c = 3e-6, 2
    w, slope = WIDTH_M[c], 10.0 / LENGTH_M[c]
    half = w / 2

    def profile(y):
        return slope / 2e-3 * (half**2 - y**2) + b * slope * half / 1e-3

    expected = DEPTH_M * quad(profile, -half, half)[0]
    assert network(lab, slip=b).flow(c, 10.0, 0.0) == pytest.approx(expected, rel=1e-9)


def test_power_law_against_the_velocity_profile(lab):
    n, c = 0.9, 3
    w, slope = WIDTH_M[c], 10.0 / LENGTH_M[c]
    consistency = 1e-3 * 100.0 ** (1 - n)

    def speed(y):
        return quad(lambda s: (slope * s / consistency) ** (1 / n), y, w / 2)[0]

    expected = 2 * DEPTH_M * quad(speed, 0.0, w / 2)[0]
    assert network(lab, thinning=0.1).flow(c, 10.0, 0.0) == pytest.approx(expected, rel=1e-6)
    assert network(lab, thinning=0.1).flow(c, 0.0, 10.0) == pytest.approx(-expected, rel=1e-6)


def test_compliance_against_the_pressure_along_the_channel(lab):
    c, k = 4, 1e-3
    q = network(lab, compliance=k).flow(c, 30.0, 5.0) / DEPTH_M
    w = WIDTH_M[c]
    end = solve_ivp(
        lambda _, p: -12e-3 * q / (w * (1 + k * p)) ** 3,
        (0, LENGTH_M[c]),
        [30.0],
        rtol=1e-10,
        atol=1e-10,
    ).y[0, -1]
    assert end == pytest.approx(5.0, abs=1e-6)


def test_entrance_loss_balances_the_drop(lab):
    c, drop = 2, 20.0
    q = network(lab, inertia=5.0).flow(c, drop, 0.0)
    u = q / (WIDTH_M[c] * DEPTH_M)
    viscous = q * 12e-3 * LENGTH_M[c] / (DEPTH_M * WIDTH_M[c] ** 3)
    assert viscous + 5.0 * 500.0 * u**2 == pytest.approx(drop, rel=1e-9)


def test_a_branch_that_cracks_open(lab):
    low = network(lab, cracking=1.0).steady(1e-9, 0.0, np.zeros(2))[0]
    assert low[2] == 0.0
    assert low[:2].sum() == pytest.approx(1e-9, rel=1e-8)
