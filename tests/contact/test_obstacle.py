"""Poses, motion and coefficients of obstacles."""

import math

import pytest
import torch

from diffsim import contact, mesh
from tests.contact.cases import points, rotated, tensor, uniform, unit


def turning_box(**changes):
    """A box with a pose and a motion of no symmetry."""
    options = {
        "position": (0.2, -0.1, 0.3),
        "rotation": (0.4, -0.7, 0.2),
        "velocity": (0.5, 0.3, -0.2),
        "angular_velocity": (1.0, 2.0, -3.0),
    }
    return contact.box((0.9, 1.1, 1.3), **{**options, **changes})


@pytest.mark.reference
def test_a_posed_box_is_the_box_in_its_own_frame():
    x, angle = uniform(50, 3, seed=1), 1.1
    axis = (0.3, -0.5, 0.8)
    turn = rotated(axis, angle)
    vector = angle * unit(tensor(*axis))
    box = contact.box((0.9, 1.1, 1.3), position=(0.2, -0.1, 0.3), rotation=vector)
    phi, normal = box.distance_normal(x)
    local, local_normal = box.shape.distance_normal((x - tensor(0.2, -0.1, 0.3)) @ turn)
    torch.testing.assert_close(phi, local, rtol=0, atol=1e-14)
    torch.testing.assert_close(normal, local_normal @ turn.T, rtol=0, atol=1e-14)
    torch.testing.assert_close(box.rotation, turn, rtol=0, atol=1e-15)
    again = contact.box((0.9, 1.1, 1.3), position=(0.2, -0.1, 0.3), rotation=turn)
    torch.testing.assert_close(again.distance_normal(x)[0], phi, rtol=0, atol=1e-14)


@pytest.mark.property
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.00999, 0.01001, 1.0, math.pi, 7.0])
def test_rotation_vector_at_every_angle(angle):
    axis = (0.3, -0.5, 0.8)
    vector = (angle * unit(tensor(*axis))).clone()
    box = contact.box((1, 1, 1), rotation=vector)
    torch.testing.assert_close(box.rotation, rotated(axis, angle), rtol=0, atol=5e-15)
    leaf = vector.requires_grad_()
    assert torch.autograd.gradcheck(lambda w: contact.sphere(1.0, rotation=w).rotation, leaf)


@pytest.mark.property
def test_motion_composes_exactly_and_carries_points_along():
    box, dt = turning_box(), 0.3
    once, thrice = box.after(0.9), box.after(0.3).after(0.3).after(0.3)
    torch.testing.assert_close(once.rotation, thrice.rotation, rtol=0, atol=1e-14)
    torch.testing.assert_close(once.position, thrice.position, rtol=0, atol=1e-15)
    x = points(20)
    carried = x + box.displacement(x, dt)
    before, after = box.distance_normal(x)[0], box.after(dt).distance_normal(carried)[0]
    torch.testing.assert_close(before, after, rtol=0, atol=1e-14)


@pytest.mark.order
def test_point_velocity_is_the_rate_of_displacement():
    box, x = turning_box(), points(20)
    errors = []
    for dt in (1e-3, 1e-4):
        central = (box.displacement(x, dt) - box.displacement(x, -dt)) / (2 * dt)
        errors.append(float((central - box.point_velocity(x)).abs().max()))
    assert errors[1] < 2e-2 * errors[0] < 1e-5  # second order


@pytest.mark.property
def test_small_displacements_do_not_cancel():
    far = tensor((1e3, -2e3, 5e2))
    box = contact.box((1, 1, 1), angular_velocity=(1e-9, 0.0, 2e-9))
    exact = torch.linalg.cross(tensor((1e-9, 0.0, 2e-9)), far) * 1e-3
    torch.testing.assert_close(box.displacement(far, 1e-3), exact, rtol=1e-11, atol=0)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: contact.Obstacle(mesh.sdf.sphere(1.0)), TypeError, r"as contact.Custom\(sdf\)"),
        (lambda: contact.floor(rotation=2 * torch.eye(3).double()), ValueError, "rotation matrix"),
    ],
)
def test_bad_input_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_check_clear_names_the_obstacle_the_count_and_the_depth():
    m = mesh.tet_box((4, 4, 4), (1.0, 1.0, 1.0))
    contact.check_clear([contact.floor(0.0), contact.sphere(0.5, position=(2, 0, 0))], m, m.x_rest)
    post = contact.sphere(0.3, position=(0.5, 0.5, 0.5), name="post")
    with pytest.raises(ValueError, match=r"'post' starts inside the body: \d+ of .* 0\.3 m; move"):
        contact.check_clear([contact.floor(), post], m, m.x_rest)
    with pytest.raises(ValueError, match=r"obstacle 0 \(Plane\) starts inside"):
        contact.check_clear([contact.floor(0.1)], m, m.x_rest)
    contact.check_clear([contact.floor(0.1)], m, m.x_rest, tolerance=0.1)


def test_an_obstacle_at_rest_stays_itself_but_keeps_the_gradient_of_its_motion():
    still = contact.sphere(0.4, position=(0.1, 0.2, 0.3))
    assert still.after(0.1) is still
    assert not bool(still.displacement(tensor((1.0, 0.0, 0.0)), 0.1).any())
    velocity = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    spin = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    moving = contact.sphere(0.4, velocity=velocity, angular_velocity=spin)
    (moving.after(0.1).position[0] + moving.displacement(tensor((1.0, 0, 0)), 0.1)[0, 1]).backward()
    torch.testing.assert_close(velocity.grad, tensor(0.1, 0.1, 0.0))
    torch.testing.assert_close(spin.grad, tensor(0.0, 0.0, 0.1))
