"""Signed distances and normals against closed forms and finite differences."""

import math

import pytest
import torch

from diffsim import contact, mesh
from diffsim.contact.height_field import _pad_by_extrapolation
from diffsim.core.errors import MeshError
from diffsim.stokes import shapes
from tests.contact.cases import SHAPES, points, tensor, uniform, unit, waves

KINDS = list(SHAPES)


@pytest.mark.property
@pytest.mark.parametrize("kind", KINDS)
def test_normal_is_the_gradient_of_the_distance(kind):
    make, parameters = SHAPES[kind]
    x = points(40).requires_grad_()
    phi, normal = make(*parameters).distance_normal(x)
    (slope,) = torch.autograd.grad(phi.sum(), x)
    assert bool((phi > 0).any()) and bool((phi < 0).any())
    torch.testing.assert_close(slope, normal, rtol=0, atol=1e-12)  # rounding
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(40).double(), rtol=0, atol=1e-14)


@pytest.mark.property
@pytest.mark.parametrize("kind", KINDS)
def test_on_the_surface_distance_vanishes_and_its_gradient_is_the_normal(kind):
    make, parameters = SHAPES[kind]
    shape, x = make(*parameters), points(60)
    phi, normal = shape.distance_normal(x)
    inside = (phi < 0) & (phi > -0.1)  # closest to a face, not to an edge or a corner
    foot = (x - phi[:, None] * normal)[inside].requires_grad_()
    again, outwards = shape.distance_normal(foot)
    (slope,) = torch.autograd.grad(again.sum(), foot)
    assert len(foot) and again.abs().max() < 1e-14
    torch.testing.assert_close(slope, outwards, rtol=0, atol=1e-12)
    torch.testing.assert_close(outwards, normal[inside], rtol=0, atol=1e-9)


@pytest.mark.property
@pytest.mark.parametrize("kind", KINDS)
def test_inside_out_changes_signs_alone(kind):
    make, parameters = SHAPES[kind]
    shape = make(*parameters)
    phi, normal = shape.distance_normal(points())
    shape.inside_out = True
    other, flipped = shape.distance_normal(points())
    torch.testing.assert_close(other, -phi, rtol=0, atol=0)
    torch.testing.assert_close(flipped, -normal, rtol=0, atol=0)


KINKS = {
    "sphere": tensor((0.0, 0.0, 0.0)),
    "capsule": tensor((-0.4, 0.1, 0.0), (0.05, 0.15, 0.15)),
    # center, corner, edge, face, outside an edge, on a diagonal of the inside
    "box": tensor(
        (0.0, 0.0, 0.0), (0.45, 0.55, 0.65), (0.45, 0.55, 0.1), (0.45, 0.1, 0.1), (0.5, 0.6, 0.0),
        (0.35, 0.45, 0.0),
    ),
    "trough": tensor((0.0, 0.3, 0.0), (-(0.32**0.5), 0.0, -(0.32**0.5))),
    "height field": tensor((0.0, 0.2, 0.0), (-1.0, -0.8, 0.0), (-1.5, -2.0, 0.3), (1.4, 1.5, -0.2)),
    "mesh": tensor((0.5, 0.6, 0.45), (0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (1.0, 1.2, 0.9)),
    "custom": tensor((0.0, 0.0, 0.0), (0.6, 0.0, 0.0), (0.0, 0.9, 0.0)),
}  # fmt: skip


@pytest.mark.grad
@pytest.mark.parametrize("kind", list(KINKS))
def test_values_and_gradients_at_kinks_are_finite(kind):
    make, parameters = SHAPES[kind]
    x = KINKS[kind].clone().requires_grad_()
    leaves = [x, *(p.clone().requires_grad_() for p in parameters)]
    phi, normal = make(*leaves[1:]).distance_normal(x)
    assert torch.isfinite(phi).all()
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(len(x)).double(), rtol=0, atol=1e-12)
    weight = tensor(1.0, 2.0, 3.0)
    for grad in torch.autograd.grad(phi.sum() + (normal @ weight).sum(), leaves, allow_unused=True):
        assert grad is None or torch.isfinite(grad).all()


def test_sphere_capsule_box_and_plane_in_numbers():
    phi, normal = contact.Sphere(0.5).distance_normal(tensor((0.0, 0.0, 2.0), (0.3, 0.0, 0.0)))
    assert phi.tolist() == pytest.approx([1.5, -0.2])
    assert normal.tolist() == [[0, 0, 1], [1, 0, 0]]
    capsule = contact.Capsule((0, 0, -1), (0, 0, 1), 0.25)
    phi, _ = capsule.distance_normal(tensor((0.0, 1.0, 0.5), (0.0, 3.0, 5.0)))
    assert phi.tolist() == pytest.approx([0.75, 4.75])  # across the middle; 3-4-5 from the end
    box = contact.Box((2.0, 4.0, 6.0))
    phi, normal = box.distance_normal(
        tensor((0.9, 0.0, 0.0), (1.5, 0.0, 0.0), (-4.0, 6.0, 0.0), (1.0, 2.0, 3.0))
    )
    assert phi.tolist() == pytest.approx([-0.1, 0.5, 5.0, 0.0])
    assert normal[:3].tolist() == [[1, 0, 0], [1, 0, 0], [-0.6, 0.8, 0]]
    phi, normal = contact.Plane((0, 0, 5.0), 0.2).distance_normal(tensor((3.0, 1.0, 0.1)))
    assert (phi.item(), normal.tolist()) == (pytest.approx(-0.1), [[0, 0, 1]])


@pytest.mark.reference
def test_mesh_of_a_sphere_approaches_the_sphere():
    import trimesh

    x = 0.9 * unit(uniform(300, 3, seed=1)) * uniform(300, 1, seed=2, low=0.5, high=1.6)
    errors = []
    for level in (2, 3):
        ball = trimesh.creation.icosphere(subdivisions=level, radius=0.8)
        phi, normal = contact.MeshShape(ball).distance_normal(x)
        exact, outwards = contact.Sphere(0.8).distance_normal(x)
        errors.append(((phi - exact).abs().max().item(), (normal - outwards).norm(dim=1).max()))
    # chord height and facet angle: second and first order in the edge length
    assert errors[1][0] < 0.3 * errors[0][0] < 0.3 * 0.02
    assert errors[1][1] < 0.6 * errors[0][1] < 0.6 * 0.3


@pytest.mark.reference
def test_mesh_of_a_box_is_the_box():
    box = mesh.to_trimesh(mesh.tet_box((2, 3, 2), (1.0, 1.2, 0.9), origin=(-0.5, -0.6, -0.45)))
    x = uniform(300, 3, seed=4)
    phi, normal = contact.MeshShape(box).distance_normal(x)
    exact, outwards = contact.Box((1.0, 1.2, 0.9)).distance_normal(x)
    torch.testing.assert_close(phi, exact, rtol=0, atol=1e-14)
    torch.testing.assert_close(normal, outwards, rtol=0, atol=1e-13)


@pytest.mark.reference
def test_height_field_of_a_plane_is_the_plane():
    grid = torch.arange(6, dtype=torch.float64)
    heights = 0.3 * 0.2 * grid[:, None] - 0.5 * 0.1 * grid + 0.05
    field = contact.HeightField(heights, (0.2, 0.1), origin=(1.0, 2.0, 3.0))
    x = uniform(100, 3, seed=5) * 3.0 + tensor(1.5, 2.2, 3.0)  # on the grid and far beyond
    phi, normal = field.distance_normal(x)
    # z - 3.05 = 0.3 (x - 1) - 0.5 (y - 2)
    length = math.sqrt(1 + 0.3**2 + 0.5**2)
    offset = (3.05 - 0.3 + 1.0) / length
    exact, outwards = contact.Plane((-0.3, 0.5, 1.0), offset).distance_normal(x)
    torch.testing.assert_close(phi, exact, rtol=0, atol=1e-13)
    torch.testing.assert_close(normal, outwards, rtol=0, atol=1e-13)


@pytest.mark.order
def test_height_field_of_a_wave_converges_to_the_wave():
    # points at a known distance along the known normal of z = 0.1 sin(3 x) cos(2 y)
    u, v = uniform(50, seed=6, low=0.4, high=1.6), uniform(50, seed=7, low=0.4, high=1.2)
    slope_u = 0.3 * torch.cos(3 * u) * torch.cos(2 * v)
    slope_v = -0.2 * torch.sin(3 * u) * torch.sin(2 * v)
    outwards = unit(torch.stack([-slope_u, -slope_v, torch.ones(50).double()], 1))
    foot = torch.stack([u, v, 0.1 * torch.sin(3 * u) * torch.cos(2 * v)], 1)
    distance = uniform(50, seed=8, low=-0.3, high=0.3)  # least radius of curvature: 1.1
    errors = []
    for n in (21, 41):
        field = contact.HeightField(waves(n, n, 2.0 / (n - 1)), 2.0 / (n - 1))
        phi, normal = field.distance_normal(foot + distance[:, None] * outwards)
        errors.append((float((phi - distance).abs().max()), float((normal - outwards).norm())))
    assert errors[0][0] < 5e-4
    assert errors[1][0] < errors[0][0] / 6.0  # third order asks for 8
    assert errors[1][1] < errors[0][1] / 3.0  # one order less


@pytest.mark.property
def test_height_field_distance_is_that_of_the_closest_sample():
    """Brute force over a fine sampling of the surface, near a crest and a valley."""
    field = contact.HeightField(waves(), 0.1)
    x = uniform(60, 3, seed=9) * tensor(0.6, 0.5, 0.4) + tensor(1.0, 0.8, 0.0)
    phi, _ = field.distance_normal(x)
    u, v = torch.linspace(-0.5, 2.5, 301).double(), torch.linspace(-0.5, 2.1, 261).double()
    grid = torch.cartesian_prod(u, v)
    height = field._value(_pad_by_extrapolation(field.heights), grid)
    surface = torch.cat([grid, height[:, None]], 1)
    nearest = torch.cdist(x, surface, compute_mode="donot_use_mm_for_euclid_dist").min(1).values
    assert (phi.abs() <= nearest + 1e-12).all()
    assert (phi.abs() >= nearest - 5e-3).all()  # half a cell's diagonal of the sampling


@pytest.mark.reference
def test_custom_equals_the_primitive():
    x = points(40)
    phi, normal = contact.Custom(mesh.sdf.box((0.9, 1.1, 1.3))).distance_normal(x)
    exact, outwards = contact.Box((0.9, 1.1, 1.3)).distance_normal(x)
    torch.testing.assert_close(phi, exact, rtol=0, atol=1e-15)
    torch.testing.assert_close(normal, outwards, rtol=0, atol=1e-15)
    with torch.no_grad():
        again, _ = contact.Custom(mesh.sdf.box((0.9, 1.1, 1.3))).distance_normal(x)
    assert not again.requires_grad and torch.equal(again, phi)


@pytest.mark.grad
def test_custom_passes_gradients_to_what_the_function_holds():
    radius = tensor(0.5)[0].requires_grad_()
    shape = contact.Custom(lambda x: x.norm(dim=1) - radius)
    (grad,) = torch.autograd.grad(shape.distance_normal(points())[0].sum(), radius)
    assert grad.item() == -12.0


def test_shapes_keep_batch_axes_and_take_no_points():
    for make, parameters in SHAPES.values():
        phi, normal = make(*parameters).distance_normal(points().reshape(2, 3, 2, 3))
        assert phi.shape == (2, 3, 2) and normal.shape == (2, 3, 2, 3)
        phi, normal = make(*parameters).distance_normal(torch.empty(0, 3).double())
        assert phi.shape == (0,) and normal.shape == (0, 3)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: contact.Plane((0, 0, 0)), ValueError, "normal must not be zero"),
        (lambda: contact.Capsule((0, 0, 1), (0, 0, 1), 0.1), ValueError, "must differ; use Sphere"),
        (lambda: contact.Trough(1, 1, start=(0, 1, 1)), ValueError, "perpendicular to axis"),
        (
            lambda: contact.HeightField(torch.zeros(2, 5).double(), 0.1),
            ValueError,
            "at least 3 x 3",
        ),
        (lambda: contact.Custom(3), TypeError, "sdf must be callable, got int"),
        (
            lambda: contact.Custom(lambda x: x).distance_normal(points()),
            ValueError,
            r"one distance per point, \(12,\), got \(12, 3\)",
        ),
    ],
)
def test_bad_input_is_refused(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_an_open_mesh_is_refused():
    import trimesh

    box = trimesh.creation.box()
    box.faces = box.faces[1:]
    with pytest.raises(MeshError, match="not watertight"):
        contact.MeshShape(box)


def test_a_shape_is_a_signed_distance_for_meshes_and_flows_too():
    """One sign in all rooms: negative in the solid, so a contact shape cuts a mesh and a flow."""
    ball, x = contact.Sphere(0.5), points(50)
    same = mesh.sdf.sphere(0.5)(x)
    assert torch.equal(ball(x), same)
    assert torch.equal(shapes.Sphere(0.5)(x), same)
    block, bounds = mesh.sdf.box((1.0,) * 3), ((-0.6,) * 3, (0.6,) * 3)
    carved = mesh.hex_from_sdf(mesh.sdf.difference(block, ball), bounds, 0.1)
    removed = mesh.hex_from_sdf(block, bounds, 0.1).num_elements - carved.num_elements
    assert removed == mesh.hex_from_sdf(ball, bounds, 0.1).num_elements > 0
    wall = shapes.Custom(ball)
    assert torch.equal(wall(x), same)
