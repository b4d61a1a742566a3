"""Half spaces of a step: choice, linearization, fast motion, restitution, gradients."""

import math

import pytest
import torch

from diffsim import contact, mesh
from tests.contact.cases import points, tensor, uniform, waves
from tests.gradients import check_directions

DT = 0.01


def half_space(planes, x):
    """Signed distance of x to the half spaces, (c,) [m]."""
    return ((x - planes.reference) * planes.normal).sum(-1) - planes.offset


@pytest.mark.reference
def test_a_floor_gives_its_own_half_space():
    floor = contact.floor(0.2, friction=0.3, restitution=0.0)
    start, end = points(30), points(30, seed=5)
    planes = contact.detect([floor], start, end, DT)
    x = uniform(30, 3, seed=2)
    torch.testing.assert_close(half_space(planes, x), x[:, 2] - 0.2, rtol=0, atol=1e-15)
    torch.testing.assert_close(planes.distance, start[:, 2] - 0.2, rtol=0, atol=0)
    assert torch.equal(planes.reference, start) and bool((planes.friction == 0.3).all())


@pytest.mark.property
def test_half_spaces_are_phi_at_the_end_to_first_order():
    obstacle = contact.sphere(0.7, velocity=(1.0, 2.0, 0.5), angular_velocity=(1.0, 0.0, 2.0))
    start, end = points(30), points(30) + 0.01 * uniform(30, 3, seed=6)
    planes = contact.detect([obstacle], start, end, DT)
    phi, normal = obstacle.after(DT).distance_normal(end)
    torch.testing.assert_close(half_space(planes, end), phi, rtol=0, atol=1e-15)
    torch.testing.assert_close(planes.normal, normal, rtol=0, atol=1e-15)


def test_each_point_gets_the_obstacle_that_it_is_deepest_in():
    many = [contact.floor(), contact.plane((-1, 0, 0), -0.5), contact.sphere(0.2)]
    x = tensor((0.0, 0.5, 0.01), (0.49, 0.5, 0.2), (0.0, 0.0, 0.15), (0.5, 0.0, 0.01))
    planes = contact.detect(many, x, x, DT)
    assert planes.obstacle.tolist() == [0, 1, 2, 1]
    batched = contact.detect(many, x.reshape(2, 2, 3), x.reshape(2, 2, 3), DT)
    assert batched.obstacle.tolist() == [[0, 1], [2, 1]]
    for flat, rows in zip(planes, batched, strict=True):
        assert torch.equal(flat.reshape(rows.shape), rows)
    empty = contact.detect(many, x[:0], x[:0], DT)
    assert empty.normal.shape == (0, 3) and empty.obstacle.dtype == torch.int64


@pytest.mark.reference
def test_reference_moves_with_a_turning_table():
    """A node that sticks to a turntable has no slip: x = reference on the arc, not its tangent."""
    table = contact.floor(angular_velocity=(0.0, 0.0, 10.0), friction=math.inf)
    x = tensor((1.0, 0.0, 0.0))
    planes = contact.detect([table], x, x, 0.1)
    assert planes.reference[0].tolist() == pytest.approx([math.cos(1.0), math.sin(1.0), 0.0])
    assert planes.offset.item() == pytest.approx(0.0, abs=1e-15)


PLATES = {
    "box": lambda: contact.Box((2.0, 2.0, 1e-3)),
    "mesh": lambda: contact.MeshShape(
        mesh.to_trimesh(mesh.tet_box((2, 2, 1), (2.0, 2.0, 1e-3), origin=(-1, -1, -5e-4)))
    ),
    "custom": lambda: contact.Custom(mesh.sdf.box((2.0, 2.0, 1e-3))),
    "capsules' row": lambda: contact.Capsule((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5e-4),
}


@pytest.mark.property
@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("kind", list(PLATES))
def test_nothing_tunnels_through_a_thin_plate(kind, side):
    """300 m/s through a millimeter: 3 m in one step."""
    plate = contact.Obstacle(PLATES[kind](), position=(0.1, 0.2, 0.3), rotation=(0.3, -0.2, 0.1))
    x, y = uniform(40, seed=1, low=-0.7, high=0.7), uniform(40, seed=2, low=-0.7, high=0.7)
    if kind.startswith("capsule"):
        y = 0.0 * y
    start = torch.stack([x, y, side * uniform(40, seed=3, low=5e-4, high=1.4)], 1)
    end = torch.stack([x, y, side * uniform(40, seed=4, low=-1.6, high=-1e-4)], 1)
    planes = contact.detect([plate], plate.to_world(start), plate.to_world(end), DT)
    upwards = side * plate.rotation[:, 2]
    torch.testing.assert_close(planes.normal, upwards.expand(40, 3), rtol=0, atol=1e-9)
    # the half space is that of the face where the path enters
    height = half_space(planes, plate.to_world(end))
    torch.testing.assert_close(height, side * end[:, 2] - 5e-4, rtol=0, atol=1e-11)
    without = contact.detect(
        [plate], plate.to_world(start), plate.to_world(end), DT, continuous=False
    )
    assert bool((half_space(without, plate.to_world(end)) > 0.01).any())  # the test has a subject


@pytest.mark.property
def test_a_fast_plate_does_not_pass_over_resting_points():
    plate = contact.box((2, 2, 1e-3), position=(0, 0, -1), velocity=(0, 0, 200.0))
    x = torch.cat([uniform(20, 2, seed=1, low=-0.9, high=0.9), torch.zeros(20, 1)], 1).double()
    planes = contact.detect([plate], x, x, DT)
    torch.testing.assert_close(planes.normal, tensor(0.0, 0.0, 1.0).expand(20, 3))
    # they must end above the plate, which ends at z = 1
    torch.testing.assert_close(half_space(planes, x), (x[:, 2] - 1.0005), rtol=0, atol=1e-12)


@pytest.mark.property
def test_a_fast_path_meets_the_first_of_several_plates():
    plates = [contact.box((1, 1, 0.01), position=(0, 0, z)) for z in (-0.5, 0.4, 0.0)]
    planes = contact.detect(plates, tensor((0.0, 0.0, 1.0)), tensor((0.0, 0.0, -0.5)), DT)
    assert planes.obstacle.item() == 1
    assert half_space(planes, tensor((0.0, 0.0, 0.405))).item() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.property
def test_a_ridge_of_terrain_stops_what_flies_through_it():
    heights = torch.zeros(21, 21).double()
    heights[10] = 0.5
    terrain = contact.Obstacle(contact.HeightField(heights, 0.1, origin=(-1, -1, 0)))
    start, end = tensor((-0.5, 0.0, 0.2)), tensor((0.5, 0.0, 0.2))
    planes = contact.detect([terrain], start, end, DT)
    assert planes.normal[0, 0].item() < -0.9
    assert half_space(planes, end).item() < -0.4


@pytest.mark.property
@pytest.mark.parametrize("shape", [contact.Sphere(0.5), contact.Box((1, 1, 1))])
def test_sliding_and_resting_points_are_linearized_where_they_end(shape):
    """No false tunneling: on the surface, moving along it and a little into it."""
    obstacle = contact.Obstacle(shape)
    x = points(60)
    phi, normal = shape.distance_normal(x)
    start = x - phi[:, None] * normal
    along = uniform(60, 3, seed=8)
    along = along - (along * normal).sum(1, keepdim=True) * normal
    end = start + 0.02 * along - 1e-4 * normal
    same_face = (shape.distance_normal(end)[1] * shape.distance_normal(start)[1]).sum(1) > 0
    planes = contact.detect([obstacle], start[same_face], end[same_face], DT)
    expected, _ = shape.distance_normal(end[same_face])
    torch.testing.assert_close(half_space(planes, end[same_face]), expected, rtol=0, atol=1e-15)
    assert int(same_face.sum()) > 40


@pytest.mark.reference
def test_restitution_is_newtons_law_on_the_displacement():
    """v+ = -e v-, relative to a floor that rises, where the step would end inside."""
    e, lift = 0.6, 0.5
    floor = contact.floor(velocity=(0.3, 0.0, lift), restitution=e)
    start = tensor((0.0, 0.0, 0.01), (0.0, 0.0, 0.05), (0.0, 0.0, -0.001))
    velocity = tensor((1.0, 0.0, -2.0), (1.0, 0.0, -2.0), (0.0, 0.0, 3.0))
    planes = contact.detect([floor], start, start + velocity * DT, DT)
    rise = (planes.offset / DT).tolist()  # normal displacement against the floor
    assert rise[0] == pytest.approx(e * (2.0 + lift))  # hits: bounces
    assert rise[1] == pytest.approx(-0.05 / DT)  # does not reach the floor: its gap stays free
    assert rise[2] == pytest.approx(0.001 / DT)  # inside but leaving: pushed out, no bounce
    plain = contact.detect([contact.floor()], start, start + velocity * DT, DT)
    torch.testing.assert_close(plain.offset, -start[:, 2], rtol=0, atol=1e-16)


@pytest.mark.reference
def test_a_fast_point_bounces_off_the_plate_that_it_would_pass():
    plate = contact.box((1, 1, 0.01), restitution=0.5)
    planes = contact.detect([plate], tensor((0.0, 0.0, 0.1)), tensor((0.0, 0.0, -1.9)), DT)
    assert (planes.offset / DT).item() == pytest.approx(0.5 * 200.0)


def test_push_out_is_limited_to_a_speed():
    start = tensor((0.0, 0.0, -0.1), (0.0, 0.0, -0.002), (0.0, 0.0, 0.1))
    free = contact.detect([contact.floor()], start, start, DT)
    slow = contact.detect([contact.floor()], start, start, DT, max_depenetration_speed=0.5)
    assert free.offset.tolist() == pytest.approx([0.1, 0.002, -0.1])
    assert slow.offset.tolist() == pytest.approx([0.005, 0.002, -0.1])
    held = contact.detect([contact.floor()], start, start, DT, max_depenetration_speed=0.0)
    assert held.offset.tolist() == pytest.approx([0.0, 0.0, -0.1])


def _scene(position, rotation, velocity, angular_velocity, friction, restitution, radius):
    motion = {
        "rotation": rotation,
        "velocity": velocity,
        "angular_velocity": angular_velocity,
        "friction": friction,
        "restitution": restitution,
    }
    ball = contact.sphere(radius, position=position, **motion)
    return [ball, contact.box((4.0, 4.0, 0.02), position=position - 1.0, **motion)]


@pytest.mark.grad
def test_gradients_to_everything():
    """Points that rest, bounce, start inside, and fly through a sphere and a plate."""
    start = tensor(
        (0.1, 0.2, 0.75), (0.4, 0.1, 0.4), (0.1, 0.0, 1.5), (-0.7, -0.9, 0.5), (-1.0, -1.1, -0.97)
    )
    end = tensor(
        (0.1, 0.1, 0.6), (0.4, 0.1, 0.45), (0.0, 0.1, -0.8), (-1.0, -1.1, -1.9), (-1.0, -1.0, -0.9)
    )
    numbers = [
        tensor(0.01, -0.02, 0.03),
        tensor(0.2, 0.1, -0.15),
        tensor(0.1, 0.2, -0.3),
        tensor(0.4, -0.3, 0.2),
        tensor(0.3)[0],
        tensor(0.6)[0],
        tensor(0.7)[0],
    ]
    leaves = [t.clone().requires_grad_() for t in (start, end, *numbers)]

    def floats(x0, x1, *p):
        planes = contact.detect(_scene(*p), x0, x1, 0.1, max_depenetration_speed=1.0)
        return planes[:5] + planes[6:]

    planes = contact.detect(_scene(*numbers), start, end, 0.1, max_depenetration_speed=1.0)
    still = contact.detect(_scene(*numbers), start, end, 0.1, continuous=False)
    assert planes.obstacle.tolist() == [0, 0, 0, 1, 1]
    assert (planes.normal - still.normal).norm(dim=1).gt(1).tolist() == [
        False, False, True, True, False
    ]  # fmt: skip
    assert (planes.distance < 0).tolist() == [False, True, False, False, False]
    check_directions(floats, leaves, seeds=(0, 1))


@pytest.mark.grad
def test_at_the_touching_point_values_are_continuous_and_gradients_finite():
    """On the surface exactly, at rest: distance zero, offset zero, finite gradients."""
    start = tensor((0.0, 0.0, 0.5), (0.5, 0.5, 0.5), (0.0, 0.0, 0.0)).requires_grad_()
    planes = contact.detect([contact.box((1, 1, 1), restitution=0.5)], start, start, DT)
    assert planes.offset[:2].tolist() == [0.0, 0.0] and planes.offset[2].item() == 0.5
    total = planes.offset.sum() + (planes.normal * uniform(3, 3)).sum() + planes.distance.sum()
    assert torch.isfinite(torch.autograd.grad(total, start)[0]).all()


@pytest.mark.grad
def test_heights_of_terrain_get_gradients():
    heights = waves(4, 4).requires_grad_()
    x = tensor((0.11, 0.17, 0.02)).requires_grad_()

    def offsets(h, x):
        terrain = contact.Obstacle(contact.HeightField(h, 0.1))
        planes = contact.detect([terrain], x + tensor(0.0, 0.0, 0.03), x, DT)
        return planes.offset, planes.normal

    check_directions(offsets, (heights, x), seeds=(0, 1))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda x: contact.detect([], x, x, DT), ValueError, "at least one Obstacle"),
        (lambda x: contact.detect([contact.Sphere(1)], x, x, DT), TypeError, "use contact.Obst"),
        (
            lambda x: contact.detect([contact.floor()], x, x, DT, max_depenetration_speed=-1.0),
            ValueError,
            "max_depenetration_speed must be >= 0",
        ),
    ],
)
def test_bad_input_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call(points(3))


@pytest.mark.property
@pytest.mark.parametrize("make", [contact.floor, lambda: contact.sphere(0.4, friction=0.2)])
def test_one_obstacle_alone_gives_what_it_gives_beside_a_far_one(make):
    start, end = points(30), points(30, seed=5)
    alone = contact.detect([make()], start, end, DT)
    far = contact.sphere(0.1, position=(0.0, 0.0, 50.0))
    for one, two in zip(alone, contact.detect([make(), far], start, end, DT), strict=True):
        assert torch.equal(one, two)
