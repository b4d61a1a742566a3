"""The channel network against linear algebra, quadrature and conservation of mass."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

from labs.virtual import NetworkLab
from labs.virtual.channel_network import (
    BLOCKAGE,
    BOX_M,
    DENSITY_KG_M3,
    DEPTH_M,
    ENDS,
    LENGTH_M,
    POSITION_M,
    TAP_M,
    WIDTH_M,
    _Network,
)
from tests.labs.truths import exact

pytestmark = pytest.mark.reference
PUMP = 8e-9
ETA = 5e-3


@pytest.fixture(scope="module")
def lab():
    return NetworkLab()


def network(lab, **effects):
    return _Network(exact(lab, {}, **effects))


def steady(lab, back=0.0, **effects):
    return network(lab, **effects).steady(PUMP, back, np.zeros(3))[0]


def test_plain_network_against_a_linear_solve(lab):
    g = DEPTH_M * WIDTH_M**3 / (12 * ETA * LENGTH_M)
    back = 7.0
    matrix = np.array([[g[1] + g[2], -g[1]], [-g[1], g[1] + g[3] + g[4]]])
    p = np.linalg.solve(matrix, [PUMP + g[2] * back, 0.0])
    pump = p[0] + PUMP / g[0]
    tap = pump + TAP_M / LENGTH_M[0] * (p[0] - pump)
    expected = [g[2] * (p[0] - back), g[3] * p[1], g[4] * p[1], pump, tap]
    np.testing.assert_allclose(steady(lab, back), expected, rtol=1e-8)


def test_hydraulic_lengths_are_near_the_drawn_ones(lab):
    """A branch drawn from the middle of a wider one is shorter by part of that one's width."""
    drawn = [np.subtract(POSITION_M[b], POSITION_M[a]) for a, b in ENDS]
    taken = np.linalg.norm(drawn, axis=1) - LENGTH_M
    assert (np.abs(taken) < WIDTH_M.max()).all()
    branches = [i for i, (start, end) in enumerate(ENDS) if end.startswith("outlet")]
    assert (taken[branches] > 0.0).all()


def test_mass(lab):
    for name in ("slip", "compliance", "thinning", "entrance_loss", "blocked_branch", "cracking"):
        out = steady(lab, **{name: lab.effects[name].typical, **_filled(lab, name)})
        assert out[:3].sum() == pytest.approx(PUMP, rel=1e-8)
    out = steady(lab, leak=1e-11)
    assert PUMP - out[:3].sum() == pytest.approx(1e-11 * out[3], rel=1e-6)


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
        return slope / (2 * ETA) * (half**2 - y**2) + b * slope * half / ETA

    expected = DEPTH_M * quad(profile, -half, half)[0]
    assert network(lab, slip=b).flow(c, 10.0, 0.0) == pytest.approx(expected, rel=1e-9)


def test_thinning_against_the_velocity_profile(lab):
    n, c, reference = 0.3, 3, 100.0
    w, slope = WIDTH_M[c], 60.0 / LENGTH_M[c]

    def rate(stress):
        def excess(g):
            return ETA * g * (1.0 + (g / reference) ** 2) ** (-n / 2) - stress

        return brentq(excess, 0.0, 100.0 * stress / ETA + 1e-9, rtol=1e-13)

    # half the flow: integral of y times the rate, as the wall's velocity is zero
    expected = 2 * DEPTH_M * quad(lambda y: y * rate(slope * y), 0.0, w / 2, epsrel=1e-10)[0]
    lab_flow = network(lab, thinning=n).flow
    assert lab_flow(c, 60.0, 0.0) == pytest.approx(expected, rel=1e-7)
    assert lab_flow(c, 0.0, 60.0) == pytest.approx(-expected, rel=1e-7)
    assert expected > 1.05 * network(lab).flow(c, 60.0, 0.0)


def test_blockage_against_the_pressure_along_the_channel(lab):
    c, s = 2, 0.3
    q = network(lab, blocked_branch=(s, 0.0, 0.0)).flow(c, 30.0, 0.0) / DEPTH_M

    def slope(x, _):
        away = abs(x / LENGTH_M[c] - 0.5)
        hump = 0.5 + 0.5 * np.cos(2 * np.pi * away / BLOCKAGE) if away < BLOCKAGE / 2 else 0.0
        return -12 * ETA * q / (WIDTH_M[c] * (1.0 - s * hump)) ** 3

    end = solve_ivp(slope, (0, LENGTH_M[c]), [30.0], rtol=1e-9, atol=1e-9, max_step=1e-4)
    assert end.y[0, -1] == pytest.approx(0.0, abs=1e-4)


def test_temperature_follows_the_height(lab):
    warm = network(lab, temperature_gradient=0.2)
    middle = 0.5 * (POSITION_M["J1"][1] + POSITION_M["outlet_1"][1])
    assert warm.viscosity[2] == pytest.approx(ETA * (1 + 0.2 * (middle / BOX_M[1] - 0.5)))
    assert warm.viscosity[2] < ETA < warm.viscosity[4]


def test_compliance_against_the_pressure_along_the_channel(lab):
    c, k = 4, 1e-3
    q = network(lab, compliance=k).flow(c, 30.0, 5.0) / DEPTH_M
    w = WIDTH_M[c]
    end = solve_ivp(
        lambda _, p: -12 * ETA * q / (w * (1 + k * p)) ** 3,
        (0, LENGTH_M[c]),
        [30.0],
        rtol=1e-10,
        atol=1e-10,
    ).y[0, -1]
    assert end == pytest.approx(5.0, abs=1e-6)


def test_tap_between_compliant_walls(lab):
    k = 2e-3
    out, (pump, junction, _) = network(lab, compliance=k).steady(2e-8, 0.0, np.zeros(3))
    end = solve_ivp(
        lambda _, p: -12 * ETA * 2e-8 / DEPTH_M / (WIDTH_M[0] * (1 + k * p)) ** 3,
        (0, TAP_M),
        [pump],
        rtol=1e-10,
        atol=1e-10,
    ).y[0, -1]
    assert out[4] == pytest.approx(end, rel=1e-8)
    assert junction < out[4] < pump == out[3]


def test_entrance_loss_balances_the_drop(lab):
    c, drop = 2, 20.0
    q = network(lab, entrance_loss=5.0).flow(c, drop, 0.0)
    u = q / (WIDTH_M[c] * DEPTH_M)
    viscous = q * 12 * ETA * LENGTH_M[c] / (DEPTH_M * WIDTH_M[c] ** 3)
    assert viscous + 5.0 * 0.5 * DENSITY_KG_M3 * u**2 == pytest.approx(drop, rel=1e-9)
    assert network(lab, entrance_loss=5.0).flow(c, 0.0, drop) == pytest.approx(-q, rel=1e-9)


def test_a_branch_that_cracks_open(lab):
    low = network(lab, cracking=1.0).steady(1e-9, 0.0, np.zeros(3))[0]
    assert abs(low[2]) < 1e-18
    assert low[:2].sum() == pytest.approx(1e-9, rel=1e-8)
