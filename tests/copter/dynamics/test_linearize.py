"""The linear model of a hover: the public tool's A and B, finite differences, and both forms."""

import pytest
import torch

from diffsim.copter import hover, linearize, lqr, state_rate
from diffsim.core.rotation import (
    body_rates_matrix,
    matrix_from_rpy,
    roll_pitch_of_thrust,
    skew,
)
from tests.copter.designs import random_copter
from tests.copter.vehicle.test_vehicle import NAMES, from_reference, reference


def trimmed(copter):
    result = hover(copter)
    assert result.status == "optimal"
    return result.thrusts, result.attitude


def rest_at(attitude):
    zero = torch.zeros(3, dtype=torch.float64)
    return torch.cat([zero, attitude, zero[:1], zero, zero])


@pytest.mark.reference
@pytest.mark.parametrize("name", NAMES)
def test_model_of_public_tool(name):
    facts = reference(name)
    copter = from_reference(facts)
    A, B = linearize(copter, *trimmed(copter))
    # the reference prints 12 digits
    expected = torch.tensor(facts["A"], dtype=torch.float64)
    torch.testing.assert_close(A, expected, atol=1e-12, rtol=0)
    expected = torch.tensor(facts["B"], dtype=torch.float64)
    torch.testing.assert_close(B, expected, atol=1e-10, rtol=0)


@pytest.mark.reference
def test_rotation_of_scipy():
    from scipy.spatial.transform import Rotation

    euler = torch.tensor([[0.3, -0.7, 1.2], [-1.0, 0.4, -2.0]], dtype=torch.float64)
    expected = Rotation.from_euler("ZYX", euler.flip(-1).numpy()).as_matrix()
    R = matrix_from_rpy(euler)
    torch.testing.assert_close(R, torch.from_numpy(expected), atol=1e-15, rtol=0)
    up = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    net = (R.mT @ up[:, None]).squeeze(-1)
    torch.testing.assert_close(roll_pitch_of_thrust(3.0 * net), euler[:, :2])


@pytest.mark.reference
def test_body_rates_are_the_rotation_s_velocity():
    """R' = R [omega]."""
    euler = torch.tensor([0.3, -0.7, 1.2], dtype=torch.float64)
    rates = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    R, R_rate = torch.func.jvp(matrix_from_rpy, (euler,), (rates,))
    omega = body_rates_matrix(euler) @ rates
    torch.testing.assert_close(R_rate, R @ skew(omega))


@pytest.mark.reference
def test_motion_conserves_what_it_must():
    """Without thrust: free fall in the world frame, angular momentum constant."""
    copter = random_copter(0)
    generator = torch.Generator().manual_seed(0)
    state = 0.5 * torch.randn(12, generator=generator, dtype=torch.float64)
    none = torch.zeros(6, dtype=torch.float64)
    rate = state_rate(copter, state, none)

    def world(state):
        R = matrix_from_rpy(state[3:6])
        omega = body_rates_matrix(state[3:6]) @ state[9:]
        return R @ state[6:9], R @ copter.inertia @ omega

    velocity_rate, momentum_rate = torch.func.jvp(world, (state,), (rate,))[1]
    fall = torch.tensor([0.0, 0.0, 9.81], dtype=torch.float64)
    torch.testing.assert_close(velocity_rate, fall, atol=1e-13, rtol=0)
    assert momentum_rate.abs().max() < 1e-14


@pytest.mark.parametrize("seed", [0, 3, 7])
def test_derivative_by_differences(seed):
    copter = random_copter(seed, tilt=0.5)
    thrusts, attitude = trimmed(copter)
    thrusts = thrusts + 0.3 * torch.arange(6)  # not a fixed point: its torque enters A
    A, B = linearize(copter, thrusts, attitude)
    assert A[9:, 3:6].abs().max() > 0.1
    state, e = rest_at(attitude), 1e-5

    def difference(f, x):
        moves = e * torch.eye(len(x), dtype=torch.float64)
        return torch.stack([(f(x + m) - f(x - m)) / (2 * e) for m in moves], 1)

    # truncation 1e-10, rounding 1e-16 * 100 / 1e-5
    numeric = difference(lambda x: state_rate(copter, x, thrusts), state)
    torch.testing.assert_close(A, numeric, atol=1e-7, rtol=1e-8)
    numeric = difference(lambda u: state_rate(copter, state, u), thrusts)
    torch.testing.assert_close(B, numeric, atol=1e-7, rtol=1e-8)


@pytest.mark.property
@pytest.mark.parametrize("seed", [0, 3, 7])
def test_both_forms_describe_one_motion(seed):
    """theta = E euler near the hover, so the models are similar and so are the gains."""
    copter = random_copter(seed, tilt=0.5)
    thrusts, attitude = trimmed(copter)
    A, B = linearize(copter, thrusts, attitude)
    A_vector, B_vector = linearize(copter, thrusts, attitude, form="rotation_vector")
    E = body_rates_matrix(torch.cat([attitude, attitude.new_zeros(1)]))
    eye = torch.eye(3, dtype=torch.float64)
    change = torch.block_diag(eye, E, eye, E)
    torch.testing.assert_close(change @ A, A_vector @ change, atol=1e-11, rtol=0)
    torch.testing.assert_close(change @ B, B_vector, atol=1e-11, rtol=0)
    Q, R = 10.0 * torch.eye(12, dtype=torch.float64), torch.eye(6, dtype=torch.float64)
    K = lqr(A, B, change.T @ Q @ change, R).K
    torch.testing.assert_close(K, lqr(A_vector, B_vector, Q, R).K @ change, atol=1e-9, rtol=0)


def test_bad_input():
    copter = random_copter(0)
    with pytest.raises(ValueError, match="did you mean 'euler'"):
        linearize(copter, *trimmed(copter), form="eulr")
