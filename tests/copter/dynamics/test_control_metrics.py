"""Controllability, authority, rotor-out margins, response time and clearance of multicopters."""

import math

import numpy as np
import pytest
import scipy.optimize
import torch

from diffsim.copter import (
    control_authority,
    controllability,
    disc_clearances,
    hover,
    hover_map_singular_value,
    linearize,
    lqr,
    max_hover_weight,
    min_clearance,
    response_time,
    rotor_out_margins,
)
from diffsim.copter.dynamics._thrust_lp import ThrustLimitError
from diffsim.core.errors import DiffsimError
from tests.copter.designs import random_copter
from tests.copter.vehicle.test_vehicle import NAMES, from_reference, plus_quadcopter, reference


def model_of(copter):
    result = hover(copter)
    return linearize(copter, result.thrusts, result.attitude)


def in_a_line():
    line = torch.tensor([[-0.3, 0, 0], [-0.1, 0, 0], [0.1, 0, 0], [0.3, 0, 0]], dtype=torch.float64)
    return plus_quadcopter().replace(positions=line)


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_numbers_of_public_tool(name):
    facts = reference(name)
    copter = from_reference(facts)
    A, B = model_of(copter)
    found = controllability(A, B)
    assert found.rank == 12
    assert float(found.condition) == pytest.approx(facts["ctrb_cond"], rel=1e-9)
    # its linear program stops at 1e-8 of the weight
    largest = float(max_hover_weight(copter))
    assert largest == pytest.approx(facts["max_hover_weight_N_LP"], rel=1e-8)
    Q, R = (torch.eye(n, dtype=torch.float64) for n in (12, copter.num_rotors))
    K = lqr(A, B, 10.0 * Q, R).K
    slowest = max(facts["closed_loop_eig_real_sorted"])
    assert float(response_time(A, B, K)) == pytest.approx(-1.0 / slowest, rel=1e-7)


@pytest.mark.reference
def test_payload_with_authority_of_the_pentacopter():
    """43.7 N with (0.5, 0.5, 0.05) N m kept: the design page's figure."""
    copter = from_reference(reference("pentacopter"))
    kept = max_hover_weight(copter, torque=(0.5, 0.5, 0.05))
    assert float(kept) == pytest.approx(43.7, abs=0.05)
    # the same box at that weight is just reached
    load = kept - copter.weight
    authority = control_authority(copter, torque=(0.5, 0.5, 0.05), load=load)
    assert float(authority) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.reference
def test_plus_quadcopter_by_hand():
    """Upright, symmetric: lift 4 u_max; roll by moving thrust from one side to the other."""
    copter = plus_quadcopter()
    assert float(max_hover_weight(copter)) == pytest.approx(4 * 7.2)
    share = float(copter.weight) / 4
    roll = control_authority(copter, torque=(1.0, 0.0, 0.0))
    # both rotors of the y arm change by +-d; below u_max - share, so the lower limit counts
    assert float(roll) == pytest.approx(2 * 0.25 * min(share, 7.2 - share))
    # without a rotor its opposite must stop too, and two rotors hold 14.4 N of 11.8
    expected = torch.full((4,), 14.4 / float(copter.weight), dtype=torch.float64)
    torch.testing.assert_close(rotor_out_margins(copter), expected)


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(4))
def test_authority_is_reached_in_random_directions(seed):
    """Every torque of the box can be had with hovering lift, and a corner of no larger one."""
    copter = random_copter(seed, tilt=0.1)
    box = np.array([1.0, 1.0, 0.1])
    scale = float(control_authority(copter))
    rows = np.vstack([-copter.force_matrix[2:].numpy(), copter.torque_matrix.numpy()])
    limits = [(0.0, float(m)) for m in copter.max_thrusts]

    def reached(torque):
        wrench = np.append(float(copter.weight), torque)
        return scipy.optimize.linprog(np.zeros(6), A_eq=rows, b_eq=wrench, bounds=limits).success

    rng = np.random.default_rng(seed)
    assert all(reached(scale * box * rng.uniform(-1.0, 1.0, 3)) for _ in range(20))
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    assert all(reached(0.9999 * scale * box * corner) for corner in corners)
    assert not all(reached(1.0001 * scale * box * corner) for corner in corners)


@pytest.mark.property
def test_rotor_out_margin_is_hover_without_the_yaw():
    """The bounded hover solve without that rotor and without yaw agrees on feasibility."""
    copter = random_copter(2, n=5, tilt=0.0)
    for out, margin in enumerate(rotor_out_margins(copter)):
        rest = [i for i in range(5) if i != out]
        rows = torch.cat([-copter.force_matrix[2:], copter.torque_matrix[:2]])[:, rest].numpy()
        for factor, expected in ((0.999, True), (1.001, False)):
            wrench = [float(margin * copter.weight) * factor, 0.0, 0.0]
            limits = copter.max_thrusts[rest].numpy()
            fit = scipy.optimize.lsq_linear(rows, wrench, (0.0, limits), tol=1e-14)
            assert (fit.cost < 1e-12) == expected


@pytest.mark.grad
@pytest.mark.parametrize("smoothing", [0.0, 1e-2])
def test_gradients_of_the_linear_programs(smoothing):
    copter = random_copter(1, n=7, tilt=0.2)
    box = torch.tensor([0.5, 0.4, 0.05], dtype=torch.float64, requires_grad=True)

    def metrics(mass, positions, directions, ratios, limits, box):
        changed = copter.replace(
            mass=mass,
            positions=positions,
            directions=torch.nn.functional.normalize(directions, dim=-1),
            torque_ratios=ratios,
            max_thrusts=limits,
        )
        outputs = [
            max_hover_weight(changed, torque=box, smoothing=smoothing),
            control_authority(changed, torque=box, load=2.0, smoothing=smoothing),
        ]
        return torch.stack([*outputs, *rotor_out_margins(changed)[:2]])

    values = (copter.mass, copter.positions, copter.directions, copter.torque_ratios)
    args = [t.clone().requires_grad_() for t in (*values, copter.max_thrusts)]
    # in a random direction: 47 entries of two programs each would take long; solved to 1e-10
    assert torch.autograd.gradcheck(
        metrics, [*args, box], eps=1e-5, atol=1e-5, rtol=1e-4, fast_mode=True
    )


def test_smoothing_tends_to_the_linear_program_from_below():
    copter = random_copter(3)
    sharp = float(max_hover_weight(copter, torque=(0.3, 0.3, 0.03)))
    errors = [
        sharp - float(max_hover_weight(copter, torque=(0.3, 0.3, 0.03), smoothing=mu))
        for mu in (1e-1, 1e-2, 1e-3)
    ]
    assert errors[0] > errors[1] > errors[2] > 0.0
    assert errors[2] < 2e-2 * errors[0]


def test_rotors_in_a_line_are_not_controllable():
    copter = in_a_line()
    assert float(hover_map_singular_value(copter)) < 1e-12
    assert float(hover_map_singular_value(plus_quadcopter())) > 0.05
    level = torch.zeros(2, dtype=torch.float64)
    thrusts = torch.full((4,), float(copter.weight) / 4, dtype=torch.float64)
    found = controllability(*linearize(copter, thrusts, level))
    assert found.rank == 8  # sideways motion, its velocity, roll and roll rate are missing
    assert math.isinf(float(found.condition))
    assert float(hover_map_singular_value(random_copter(0, n=3))) == 0.0
    three = random_copter(0, n=3, tilt=0.0)
    assert controllability(*linearize(three, thrusts[:3], level)).rank < 12


@pytest.mark.grad
def test_gradient_leads_out_of_the_line():
    """From next to the line, ascent on the singular value makes the hover controllable."""
    positions = in_a_line().positions + torch.tensor(
        [[0, 1e-3, 0], [0, -1e-3, 0], [0, -1e-3, 0], [0, 1e-3, 0]], dtype=torch.float64
    )
    first = None
    for _ in range(200):
        positions = positions.detach().requires_grad_()
        value = hover_map_singular_value(plus_quadcopter().replace(positions=positions))
        first = float(value.detach()) if first is None else first
        (slope,) = torch.autograd.grad(value, positions)
        positions = positions + 2e-3 * slope / slope.norm()
    assert first < 0.01
    assert float(value.detach()) > 10.0 * first


def test_response_time_of_a_first_order_lag():
    one = torch.ones(1, 1, dtype=torch.float64)
    assert float(response_time(0.0 * one, one, 4.0 * one)) == pytest.approx(0.25)
    settled = response_time(0.0 * one, one, 4.0 * one, within=0.02)
    assert float(settled) == pytest.approx(math.log(50.0) / 4.0)
    with pytest.raises(DiffsimError, match="not stable: a mode with real part 1 "):
        response_time(one, one, 0.0 * one)


def brute_force_distance(copter, i, j):
    """Between fine rims and filled discs, by an independent optimizer."""
    frames = []
    for k in (i, j):
        basis = np.linalg.svd(copter.directions[k].numpy()[None])[2][1:]
        frames.append((copter.positions[k].numpy(), basis * float(copter.radii[k])))

    def gap(x):
        (c1, b1), (c2, b2) = frames
        return np.sum((c1 + x[:2] @ b1 - c2 - x[2:] @ b2) ** 2)

    inside = [
        {"type": "ineq", "fun": lambda x: 1.0 - x[:2] @ x[:2]},
        {"type": "ineq", "fun": lambda x: 1.0 - x[2:] @ x[2:]},
    ]
    found = scipy.optimize.minimize(
        gap, np.zeros(4), constraints=inside, method="SLSQP", options={"ftol": 1e-16}
    )
    return math.sqrt(found.fun)


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(4))
def test_clearance_of_tilted_discs(seed):
    copter = random_copter(seed, tilt=0.8)
    pairs = torch.triu_indices(6, 6, 1).T.tolist()
    expected = [brute_force_distance(copter, i, j) for i, j in pairs]
    clearances = disc_clearances(copter)
    # scipy's step size limits the square
    np.testing.assert_allclose(clearances.clamp_min(0.0), expected, atol=1e-6)
    assert bool((clearances[np.less(expected, 1e-6)] < 0.0).all())


def test_clearance_in_one_plane_and_coaxial():
    quad = plus_quadcopter()
    between = 0.25 * math.sqrt(2.0)
    assert float(min_clearance(quad)) == pytest.approx(between - 2 * 0.127, abs=1e-12)
    overlapping = quad.replace(radii=torch.full((4,), 0.2, dtype=torch.float64))
    assert float(min_clearance(overlapping)) == pytest.approx(between - 0.4, abs=1e-12)
    stacked = quad.positions.clone()
    stacked[1] = stacked[0] + torch.tensor([0.0, 0.0, 0.08])
    assert float(disc_clearances(quad.replace(positions=stacked))[0]) == pytest.approx(0.08)


@pytest.mark.grad
@pytest.mark.parametrize("radius", [0.08, 0.16])
def test_gradient_of_the_clearance(radius):
    copter = random_copter(0, n=4, tilt=0.5)

    def clearances(positions, directions, radii):
        directions = torch.nn.functional.normalize(directions, dim=-1)
        changed = copter.replace(positions=positions, directions=directions, radii=radii)
        return disc_clearances(changed)

    radii = torch.linspace(radius, 1.1 * radius, 4, dtype=torch.float64)
    args = [t.clone().requires_grad_() for t in (copter.positions, copter.directions, radii)]
    assert torch.autograd.gradcheck(clearances, args, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda c: control_authority(c, torque=(0.0, 0, 0)), ValueError, "extent above 0"),
        (lambda c: control_authority(c, load=1e3), ThrustLimitError, "hold 1011.77 N"),
        (lambda c: max_hover_weight(c, torque=(50.0, 0, 0)), ThrustLimitError, "reach the torques"),
        (lambda c: controllability(c.inertia, c.positions), ValueError, "B must have shape"),
    ],
)
def test_bad_input(call, error, message):
    with pytest.raises(error, match=message):
        call(plus_quadcopter())
