"""Primitives, motions and combinations: signs, distances, gradients, ties."""

import math

import pytest
import torch

from diffsim.mesh import sdf
from diffsim.stokes.shapes import (
    BezierCurve2d,
    Box,
    Complement,
    Custom,
    Extrude,
    Intersection,
    Plane,
    Rotate,
    SmoothIntersection,
    SmoothUnion,
    Sphere,
    Translate,
    Union,
    grid_nodes,
)
from tests.helpers import random, tensor

F64 = torch.float64


POINTS = 2.0 * random(0, 200, 3) - 1.0


@pytest.mark.reference
def test_signs_and_distances_are_those_of_the_solids_of_the_mesh_module():
    center = (0.1, 0.2, -0.1)
    pairs = [
        (Sphere(0.6, center), sdf.sphere(0.6, center)),
        (Box((0.8, 0.6, 1.0), center), sdf.box((0.8, 0.6, 1.0), center)),
        (Plane((1.0, 2.0, 2.0), 0.3), sdf.plane((1.0, 2.0, 2.0), 0.3)),
        (Custom(sdf.torus(0.6, 0.2)), sdf.torus(0.6, 0.2)),
        (
            Rotate(Box((0.8, 0.6, 1.0)), 0.7, axis=(1, 2, 3)),
            sdf.rotate(sdf.box((0.8, 0.6, 1.0)), (1, 2, 3), 0.7),
        ),
        (
            Intersection(Sphere(0.5), Sphere(0.5, center)),  # fluid where neither is: solids united
            sdf.union(sdf.sphere(0.5), sdf.sphere(0.5, center)),
        ),
    ]
    for ours, theirs in pairs:
        torch.testing.assert_close(ours(POINTS), theirs(POINTS))
    flat = POINTS[:, :2]
    torch.testing.assert_close(
        Sphere(0.6, (0.1, 0.2))(flat),
        Sphere(0.6, (0.1, 0.2, 0))(torch.nn.functional.pad(flat, (0, 1))),
    )
    torch.testing.assert_close(Sphere(0.6, fluid="inside")(POINTS), 0.6 - POINTS.norm(dim=1))


def test_fluid_is_where_phi_is_positive():
    origin = tensor([0.0, 0.0, 0.0])
    assert Sphere(1.0)(origin) < 0 < Sphere(1.0, fluid="inside")(origin)
    assert Box((1, 1, 1))(origin) < 0 < Box((1, 1, 1), fluid="inside")(origin)
    assert Plane((0, 0, 1), -1.0)(origin) > 0
    one, two = Plane((1, 0, 0), 0.5), Plane((1, 0, 0), -0.5)
    assert (one | two)(origin) > 0 > (one & two)(origin)
    assert (~one)(origin) > 0
    assert Complement(one)(origin) == -one(origin)


@pytest.mark.property
def test_motions_and_extrusion_are_identities():
    outline = BezierCurve2d(tensor([[-1, 0.2], [0, -0.5], [0.3, 0.9], [1, 0.1]]))
    for axis, across in (("x", [1, 2]), ("y", [0, 2]), ("z", [0, 1])):
        torch.testing.assert_close(Extrude(outline, axis)(POINTS), outline(POINTS[:, across]))
        tracked = POINTS.clone().requires_grad_()  # takes the other way through Extrude
        torch.testing.assert_close(Extrude(outline, axis)(tracked), outline(POINTS[:, across]))
    nodes = grid_nodes((4, 5, 6), 0.3, (-0.6, -0.7, 0.0))
    torch.testing.assert_close(Extrude(outline)(nodes), outline(nodes[..., :2]))
    body = Extrude(outline) & Sphere(0.4, (0.1, 0.2, 0.3))
    torch.testing.assert_close(Rotate(body, 2 * math.pi, axis=(1, 1, 0))(POINTS), body(POINTS))
    there = Rotate(body, 0.6, axis=(1, 1, 0), center=(0.1, 0, 0.2))
    back = Rotate(there, -0.6, axis=(1, 1, 0), center=(0.1, 0, 0.2))
    torch.testing.assert_close(back(POINTS), body(POINTS))
    moved = Translate(body, (0.1, 0.2, 0.3))
    torch.testing.assert_close(moved(POINTS + tensor([0.1, 0.2, 0.3])), body(POINTS))
    # turning the outline in the plane and extruding it is turning the extrusion about z
    flat = Extrude(Rotate(outline, 0.4, axis=None, center=(0.2, 0.1)))
    solid = Rotate(Extrude(outline), 0.4, center=(0.2, 0.1, 0.0))
    torch.testing.assert_close(flat(POINTS), solid(POINTS))
    x_to_y = Rotate(Plane((1.0, 0.0, 0.0)), math.pi / 2)  # right-handed: x goes to y
    torch.testing.assert_close(x_to_y(tensor([0.0, 2.0, 0.0])), tensor(2.0))


@pytest.mark.grad
def test_at_a_tie_the_first_shape_has_the_gradient():
    a, b = tensor(0.2).requires_grad_(), tensor(0.2).requires_grad_()
    x = tensor([[0.5, 0.0, 0.0]])
    for kind in (Union, Intersection):
        grads = torch.autograd.grad(kind(Sphere(a), Sphere(b))(x).sum(), (a, b), allow_unused=True)
        assert grads[0] == -1 and (grads[1] is None or grads[1] == 0)
    smooth = torch.autograd.grad(SmoothUnion(Sphere(a), Sphere(b), radius=0.1)(x).sum(), (a, b))
    assert smooth[0] == smooth[1] == -0.5


def test_degenerate_points_have_finite_gradients():
    x = torch.zeros(1, 3, dtype=F64, requires_grad=True)
    corner = tensor([[0.5, 0.5, 0.5]]).requires_grad_()
    for shape, p in ((Sphere(1.0), x), (Box((1, 1, 1)), x), (Box((1, 1, 1)), corner)):
        (grad,) = torch.autograd.grad(shape(p).sum(), p)
        assert bool(torch.isfinite(grad).all())


@pytest.mark.property
def test_smooth_union_stays_close_to_the_sharp_one():
    a, b = Sphere(0.5), Plane((1.0, 0.0, 0.0), 0.1)
    excess = SmoothUnion(a, b, radius=0.2)(POINTS) - Union(a, b)(POINTS)
    assert excess.min() >= 0 and 0.01 < excess.max() <= 0.05
    excess = SmoothIntersection(a, b, radius=0.2)(POINTS) - Intersection(a, b)(POINTS)
    assert excess.max() <= 0 and -0.05 <= excess.min() < -0.01


def test_modules_are_level_sets_and_show_their_parameters():
    net = torch.nn.Sequential(torch.nn.Linear(3, 1, dtype=F64), torch.nn.Flatten(0))
    radius = torch.nn.Parameter(tensor(0.5))
    shape = Custom(net, dim=3) & Sphere(radius)
    assert len(list(shape.parameters())) == 3
    shape(POINTS).sum().backward()
    assert radius.grad is not None and net[0].weight.grad is not None
    assert shape(POINTS.reshape(10, 20, 3)).shape == (10, 20)
    assert shape(POINTS[:0]).shape == (0,)
    torch.testing.assert_close(shape(POINTS.T.contiguous().T), shape(POINTS))


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match="normal must not be zero"):
        Plane((0, 0, 0))
    with pytest.raises(ValueError, match="use Extrude"):
        Union(Sphere(1.0), Sphere(1.0, (0, 0)))
    with pytest.raises(ValueError, match="only a shape in the plane"):
        Extrude(Sphere(1.0))
    with pytest.raises(ValueError, match="at least one shape"):
        Union()
    with pytest.raises(ValueError, match="one value per point"):
        Custom(lambda x: x)(POINTS)
    with pytest.raises(ValueError, match=r"Custom gives no finite phi at \("):
        Custom(lambda x: x[:, 0] / 0.0)(POINTS)
    radius = torch.nn.Parameter(tensor(0.5))
    ball = Sphere(radius)
    with torch.no_grad():
        radius.fill_(math.nan)
    with pytest.raises(ValueError, match="look for NaN in its parameters"):
        ball(POINTS)
