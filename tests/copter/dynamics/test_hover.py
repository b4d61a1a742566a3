"""Hover thrusts: reference trims, other solvers, derivatives, and what is said when there is none.

The formulation solved (|M_f u| = W) differs from the one checked against here: six equations in
thrusts, roll and pitch.
"""

import numpy as np
import pytest
import scipy.optimize
import torch

from diffsim.copter import (
    Hover,
    HoverError,
    HoverWarning,
    hover,
    hover_thrusts,
    max_hover_weight,
    state_rate,
)
from diffsim.copter.dynamics import _ops_hover
from tests.copter.designs import random_copter
from tests.copter.vehicle.test_vehicle import NAMES, from_reference, plus_quadcopter, reference
from tests.gradients import check_directions
from tests.helpers import check_layer, with_derivatives


def matrices(copter):
    return copter.force_matrix, copter.torque_matrix, copter.weight, copter.max_thrusts


def slsqp(copter, start, load=0.0):
    """Least effort over thrusts, roll and pitch under the six equations, by scipy."""
    F, T = copter.force_matrix.numpy(), copter.torque_matrix.numpy()
    weight = float(copter.weight) + load
    n = copter.num_rotors

    def balance(x):
        roll, pitch = x[n:]
        sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
        down = np.array([-sp, cp * sr, cp * cr])
        return np.concatenate([(F @ x[:n]) / weight + down, T @ x[:n] / weight])

    limits = [(0.0, float(m)) for m in copter.max_thrusts] + [(-1.0, 1.0)] * 2
    return scipy.optimize.minimize(
        lambda x: 0.5 * x[:n] @ x[:n] / weight,
        start,
        jac=lambda x: np.append(x[:n] / weight, [0.0, 0.0]),
        bounds=limits,
        constraints={"type": "eq", "fun": balance},
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
    )


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_trim_of_public_tool(name):
    facts = reference(name)
    result = hover(from_reference(facts))
    assert result.status == "optimal"
    # 12 digits are printed there, and its force balances to 1e-10 of the weight
    expected = torch.tensor(facts["trim_u"], dtype=torch.float64)
    torch.testing.assert_close(result.thrusts, expected, atol=1e-9, rtol=0)
    expected = torch.tensor(facts["trim_x"][3:5], dtype=torch.float64)
    torch.testing.assert_close(result.attitude, expected, atol=1e-12, rtol=0)


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("share", [0.5, 0.99])  # of the largest weight: limits idle, limits met
def test_same_optimum_as_slsqp(seed, share):
    copter = random_copter(seed)
    load = share * float(max_hover_weight(copter)) - float(copter.weight)
    result = hover(copter, load=load)
    assert result.status == "optimal"
    if share > 0.9:
        assert result.active_upper.any()
    start = np.append(np.full(6, float(copter.weight) / 6), [0.0, 0.0])
    other = slsqp(copter, start, load)
    assert other.success
    # scipy stops where its steps no longer lower the objective in the 15th digit
    np.testing.assert_allclose(result.thrusts, other.x[:6], atol=2e-5)
    np.testing.assert_allclose(result.attitude, other.x[6:], atol=1e-5)
    effort = 0.5 * float(result.thrusts.square().sum()) / (float(copter.weight) + load)
    assert effort <= other.fun + 1e-9


@pytest.mark.property
@pytest.mark.parametrize(("seed", "n"), [(7, 4), (1, 5), (6, 5), (7, 6), (3, 7), (4, 8), (9, 12)])
def test_holds_still(seed, n):
    copter = random_copter(seed, n=n, tilt=0.5)
    assert max_hover_weight(copter) > copter.weight
    result = hover(copter)
    assert result.status == "optimal"
    assert result.attitude.abs().max() > 1e-3
    zero = torch.zeros(3, dtype=torch.float64)
    euler = torch.cat([result.attitude, zero[:1]])
    state = torch.cat([zero, euler, zero, zero])
    # accelerations of up to 10 m/s^2 and 1e3 rad/s^2 of single rotors cancel
    assert state_rate(copter, state, result.thrusts).abs().max() < 1e-11
    down = result.rot_world_from_body @ copter.force_matrix @ result.thrusts
    expected = torch.stack([zero[0], zero[0], -copter.weight])
    torch.testing.assert_close(down, expected, atol=1e-12, rtol=1e-13)


def test_least_norm_without_limits():
    copter = random_copter(3, n=7, tilt=0.0)
    result = hover(copter)
    rows = torch.cat([-copter.force_matrix[2:], copter.torque_matrix])
    wrench = torch.zeros(4, dtype=torch.float64)
    wrench[0] = copter.weight
    expected = torch.linalg.pinv(rows) @ wrench
    torch.testing.assert_close(result.thrusts, expected, atol=1e-12, rtol=0)
    heavy = torch.ones(7, dtype=torch.float64)
    heavy[2] = 50.0
    assert hover(copter, weights=heavy).thrusts[2] < 0.5 * result.thrusts[2]
    scaled = hover(copter, weights=3.0 * heavy).thrusts
    torch.testing.assert_close(scaled, hover(copter, weights=heavy).thrusts)


@pytest.mark.property
@pytest.mark.parametrize("seed", range(10))
def test_feasible_up_to_the_largest_weight(seed):
    copter = random_copter(seed, n=5 + seed % 4, tilt=0.0)
    largest = float(max_hover_weight(copter))
    below = hover(copter, load=0.999 * largest - float(copter.weight))
    above = hover(copter, load=1.001 * largest - float(copter.weight))
    assert (below.status, above.status) == ("optimal", "infeasible")
    assert below.feasible and not above.feasible
    assert below.residual_norm < 1e-12
    assert 1e-6 < above.residual_norm < 2e-3


@pytest.mark.property
@pytest.mark.parametrize("tilt", [0.2, 0.6, 1.2])
def test_finds_the_hover_that_a_linear_program_has(tilt):
    """Lift enough along the body's vertical is enough at the best attitude, whatever the tilt."""
    statuses = []
    for seed in range(30):
        copter = random_copter(100 + seed, n=4 + seed % 6, tilt=tilt)
        result = hover(copter)
        statuses.append(result.status)
        assert result.status in ("optimal", "infeasible")
        if result.status == "infeasible":
            assert max_hover_weight(copter) < copter.weight * (1.0 + 1e-9)
    assert statuses.count("optimal") > 15


@pytest.mark.grad
@pytest.mark.parametrize("share", [0.5, 0.99])
def test_contract(share):
    copter = random_copter(2)
    force, torque, weight, limits = matrices(copter)
    # every second column of a wider matrix: not contiguous
    force = torch.stack([force, force], -1).flatten(-2)[:, ::2].requires_grad_()
    weight = share * max_hover_weight(copter).detach()
    h = torch.linspace(1.0, 2.0, 6, dtype=torch.float64)
    args = [force, *(t.clone().requires_grad_() for t in (torque, weight, limits, h))]

    def layer(force, torque, weight, limits, h):
        result = hover_thrusts(force, torque, weight, limits, weights=h)
        return torch.cat([result.thrusts, result.attitude, result.residual])

    active = hover_thrusts(*args[:4], weights=h).active_upper
    assert bool(active.any()) == (share > 0.8)
    n = 6.0
    flat = [force.detach()[None] / n, torque[None], h[None], limits[None] * n / weight]
    flat = [t.detach() for t in flat]
    ops = with_derivatives(_ops_hover.hover, *flat, 0.0, 1)
    if share < 0.8:  # the limits of idle bounds have no gradient, which check_layer would refuse
        args[3] = args[3].detach()
    check_layer(layer, args, ops=ops, atol=1e-7, rtol=1e-6)


@pytest.mark.grad
@pytest.mark.parametrize("smoothing", [1e-2, 1e-5])
def test_gradient_with_smoothing(smoothing):
    copter = random_copter(4)
    args = [t.clone().requires_grad_() for t in matrices(copter)]
    args[2] = (0.9 * max_hover_weight(copter)).detach().requires_grad_()

    def layer(*args):
        return hover_thrusts(*args, smoothing=smoothing).thrusts

    check_directions(layer, args, seeds=(0, 1), atol=1e-6, rtol=1e-5, check_forward_ad=True)


@pytest.mark.grad
def test_gradient_in_the_design():
    copter = random_copter(5)

    def layer(mass, positions, directions, ratios, limits, load):
        changed = copter.replace(
            mass=mass,
            positions=positions,
            directions=torch.nn.functional.normalize(directions, dim=-1),
            torque_ratios=ratios,
            max_thrusts=limits,
        )
        result = hover(changed, load=load)
        assert result.active_upper.any()
        return result.thrusts, result.attitude

    load = (0.93 * max_hover_weight(copter) - copter.weight).detach()
    values = (copter.mass, copter.positions, copter.directions, copter.torque_ratios)
    args = [t.clone().requires_grad_() for t in (*values, copter.max_thrusts, load)]
    check_directions(layer, args, seeds=(0, 1), atol=1e-6, rtol=1e-5, check_forward_ad=True)


@pytest.mark.grad
def test_residual_leads_back_to_a_hover():
    copter = random_copter(4)
    limits = (0.4 * copter.max_thrusts).requires_grad_()
    positions = copter.positions.clone().requires_grad_()
    mass = torch.tensor(3.5, dtype=torch.float64, requires_grad=True)

    def residual_norm(mass, limits, positions):
        heavy = copter.replace(mass=mass, max_thrusts=limits, positions=positions)
        result = hover(heavy)
        return result.residual_norm, result

    norm, result = residual_norm(mass, limits, positions)
    assert result.status == "infeasible"
    assert float(norm) > 0.01
    # thrusts of the least violation are unique only thanks to 1e-6 of effort, and as stiff
    assert torch.autograd.gradcheck(
        lambda *a: residual_norm(*a)[0], (mass, limits, positions), eps=1e-7, atol=1e-5, rtol=1e-4
    )
    for _ in range(200):
        norm, result = residual_norm(mass, limits.detach(), positions.detach())
        if result.status == "optimal":
            break
        (slope,) = torch.autograd.grad(norm, mass)
        assert slope > 0.0
        mass = (mass - 1.05 * norm / slope).detach().requires_grad_()
    assert result.status == "optimal"
    heavy = copter.replace(mass=torch.tensor(7.0, dtype=torch.float64))
    with pytest.raises(HoverError, match=r"hover; nearest: lift 78.67 % of the weight"):
        hover(heavy, on_infeasible="raise")


@pytest.mark.grad
def test_kink_at_an_active_set_change():
    """Where a rotor just reaches its limit the derivative is that of one side, and said to be."""
    copter = random_copter(7, tilt=0.0)
    free = hover(copter)
    top = int(free.thrusts.argmax())
    limits = copter.max_thrusts.clone()

    def slopes(limit):
        limits[top] = limit
        weight = copter.weight.clone().requires_grad_()
        result = hover_thrusts(copter.force_matrix, copter.torque_matrix, weight, limits)
        grads = [torch.autograd.grad(u, weight, retain_graph=True)[0] for u in result.thrusts]
        return result, torch.stack(grads)

    peak = float(free.thrusts[top])
    above, slope_above = slopes(peak * (1.0 + 1e-4))
    below, slope_below = slopes(peak * (1.0 - 1e-4))
    at, slope_at = slopes(peak)
    assert not above.weakly_active.any()
    assert not below.weakly_active.any()
    assert at.weakly_active.nonzero().tolist() == [[top]]
    assert float(slope_above[top]) > 0.1
    assert float(slope_below[top]) == 0.0
    nearest = min((slope_above - slope_at).abs().max(), (slope_below - slope_at).abs().max())
    assert nearest < 1e-10  # both active sets have constant slopes here


def test_smoothing_tends_to_the_limits():
    copter = random_copter(5)
    load = float(0.93 * max_hover_weight(copter) - copter.weight)
    hard = hover(copter, load=load).thrusts
    errors = []
    for smoothing in (1e-2, 1e-4, 1e-6):
        soft = hover(copter, load=load, smoothing=smoothing)
        assert soft.status == "optimal"
        assert bool((soft.thrusts < copter.max_thrusts).all())
        errors.append(float((soft.thrusts - hard).abs().max()))
    assert errors[0] > 10.0 * errors[1] > 100.0 * errors[2]
    assert errors[2] < 1e-4 * float(hard.max())


def test_rotors_in_a_line_are_said():
    line = torch.tensor([[-0.3, 0, 0], [-0.1, 0, 0], [0.1, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
    with pytest.warns(HoverWarning, match=r"command 3 of lift, roll, pitch and yaw"):
        result = hover(plus_quadcopter().replace(positions=line))
    assert result.status == "rank_deficient"
    assert int(result.rank) == 3
    assert result.feasible
    assert result.residual_norm < 1e-12


def test_three_rotors_cannot_balance_the_yaw():
    copter = random_copter(0, n=3, tilt=0.0)
    result = hover(copter)
    assert result.status == "infeasible"
    assert result.residual_norm > 1e-3


def test_batch_is_its_entries():
    copters = [random_copter(seed, n=5) for seed in range(4)]
    columns = zip(*map(matrices, copters), strict=True)
    stacked = [torch.stack(t).reshape(2, 2, *t[0].shape) for t in columns]
    batch = hover_thrusts(*stacked, num_threads=2)
    assert len(batch.status) == 4
    for k, copter in enumerate(copters):
        single = hover(copter)
        assert torch.equal(batch.thrusts.reshape(4, 5)[k], single.thrusts)
        assert torch.equal(batch.attitude.reshape(4, 2)[k], single.attitude)
        assert int(batch.rank.flatten()[k]) == int(single.rank) == 4


def test_module():
    copter = random_copter(1)
    h = torch.linspace(1.0, 2.0, 6, dtype=torch.float64)
    layer = Hover(weights=h, smoothing=1e-4)
    expected = hover(copter, weights=h, smoothing=1e-4, load=2.0)
    assert torch.equal(layer(copter, 2.0).thrusts, expected.thrusts)
    assert "weights" in dict(layer.named_buffers())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"load": -100.0}, "weight must lie in"),
        ({"on_infeasible": "rais"}, "did you mean 'raise'"),
    ],
)
def test_bad_input(changes, message):
    with pytest.raises(ValueError, match=message):
        hover(random_copter(0), **changes)


def test_smoothing_needs_room():
    copter = random_copter(0)
    limits = copter.max_thrusts.clone()
    limits[0] = 0.0
    result = hover(copter.replace(max_thrusts=limits))
    assert float(result.thrusts[0]) == 0.0
    with pytest.raises(ValueError, match=r"max_thrusts must lie in \(0"):
        hover(copter.replace(max_thrusts=limits), smoothing=1e-3)
