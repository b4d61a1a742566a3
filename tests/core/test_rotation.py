"""All forms of a rotation agree with scipy's and with each other, and carry their gradients."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from diffsim.core import rotation as rot

CLOSE = {"rtol": 0.0, "atol": 2e-15}


def numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


def scipy_quaternion(turn: Rotation) -> torch.Tensor:
    return torch.from_numpy(turn.as_quat(canonical=False, scalar_first=True))


def test_rpy_is_scipys_extrinsic_xyz():
    rpy = numbers(20, 3)
    turn = Rotation.from_euler("xyz", rpy.numpy())
    torch.testing.assert_close(
        rot.matrix_from_rpy(rpy), torch.from_numpy(turn.as_matrix()), **CLOSE
    )
    q = rot.quaternion_from_rpy(rpy)
    torch.testing.assert_close(rot.matrix_from_quaternion(q), rot.matrix_from_rpy(rpy), **CLOSE)


def test_rpy_of_a_matrix_comes_back():
    rpy = torch.tensor([[0.3, -0.7, 1.2], [-2.8, 1.4, -3.0]], dtype=torch.float64)
    torch.testing.assert_close(rot.rpy_from_matrix(rot.matrix_from_rpy(rpy)), rpy, **CLOSE)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 5e-3, 0.02, 1.0, 3.1, 7.0])
def test_rotation_vectors(angle):
    vector = angle * torch.tensor([2.0, -1.0, 2.0], dtype=torch.float64) / 3.0
    turn = Rotation.from_rotvec(vector.numpy())
    matrix = torch.from_numpy(turn.as_matrix())
    torch.testing.assert_close(rot.matrix_from_rotation_vector(vector), matrix, **CLOSE)
    q = rot.quaternion_from_rotation_vector(vector)
    torch.testing.assert_close(rot.matrix_from_quaternion(q), matrix, rtol=0.0, atol=1e-12)
    r = numbers(4, 3, seed=1)
    offset = rot.rotation_offset(vector, r)
    torch.testing.assert_close(offset, r @ matrix.T - r, rtol=0.0, atol=4e-15)


def test_many_rotation_vectors_at_once():
    vectors = numbers(5, 2, 3, seed=4)
    turns = Rotation.from_rotvec(vectors.reshape(-1, 3).numpy()).as_matrix().reshape(5, 2, 3, 3)
    found = rot.matrix_from_rotation_vector(vectors)
    torch.testing.assert_close(found, torch.from_numpy(turns), **CLOSE)
    assert torch.equal(found[3, 1], rot.matrix_from_rotation_vector(vectors[3, 1]))


def test_offset_of_a_tiny_rotation_has_no_cancellation():
    vector = torch.tensor([0.0, 0.0, 1e-12], dtype=torch.float64)
    r = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)
    expected = torch.tensor([[-5e-25, 1e-12, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(rot.rotation_offset(vector, r), expected, rtol=1e-15, atol=0.0)


def test_quaternions_compose_and_turn_vectors():
    a, b = (Rotation.from_rotvec(numbers(6, 3, seed=k).numpy()) for k in (1, 2))
    qa, qb, r = scipy_quaternion(a), scipy_quaternion(b), numbers(6, 3, seed=3)
    turned = torch.from_numpy((a * b).apply(r.numpy()))
    both = rot.quaternion_product(qa, qb)
    torch.testing.assert_close(rot.rotate_by_quaternion(both, r), turned, rtol=0.0, atol=4e-15)
    back = rot.rotate_by_quaternion(rot.quaternion_conjugate(both), turned)
    torch.testing.assert_close(back, r, rtol=0.0, atol=8e-15)


def test_rates_of_rpy_are_angular_velocity():
    """[omega] = R' dR/dt, and the three forms of the relation agree."""
    rpy, rates = numbers(3, seed=4), numbers(3, seed=5)
    matrix, change = torch.func.jvp(rot.matrix_from_rpy, (rpy,), (rates,))
    omega = rot.body_rates_from_rpy_rates(rpy, rates)
    torch.testing.assert_close(matrix.T @ change, rot.skew(omega), rtol=0.0, atol=1e-14)
    torch.testing.assert_close(rot.body_rates_matrix(rpy) @ rates, omega, rtol=0.0, atol=1e-14)
    again = rot.rpy_rates_from_body_rates(rpy, omega)
    torch.testing.assert_close(again, rates, rtol=1e-13, atol=0.0)


@pytest.mark.parametrize(
    ("function", "size"),
    [
        (rot.matrix_from_rotation_vector, 3),
        (rot.quaternion_from_rotation_vector, 3),
        (rot.quaternion_from_rpy, 3),
        (rot.matrix_from_quaternion, 4),
        (rot.matrix_from_rpy, 3),
        (lambda rpy: rot.rpy_from_matrix(rot.matrix_from_rpy(rpy)), 3),
        (rot.body_rates_matrix, 3),
        (rot.roll_pitch_of_thrust, 3),
        (rot.skew, 3),
    ],
)
def test_gradients(function, size):
    assert torch.autograd.gradcheck(function, (0.7 * numbers(size, seed=6)).requires_grad_())


@pytest.mark.parametrize("scale", [1e-3, 1e-2, 1.0])
def test_gradients_of_offsets(scale):
    vector = (scale * numbers(3, seed=7)).requires_grad_()
    assert torch.autograd.gradcheck(
        rot.rotation_offset, (vector, numbers(2, 3, seed=8).requires_grad_())
    )
