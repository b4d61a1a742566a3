"""Spline surfaces against spheres, tori, dense sampling, and finite differences."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from torch import Tensor

from diffsim.stokes.shapes import (
    BSplineSurface,
    NurbsSurface,
    Plane,
    SplineBasis,
    grid_nodes,
)
from tests.gradients import check_directions
from tests.helpers import random, tensor

F64 = torch.float64
_HALF = math.sqrt(0.5)
_SQUARE = [[1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1], [1, 0]]
_ROUND = [_HALF, 1.0] * 4
_KNOTS = [0, 0, 0.25, 0.25, 0.5, 0.5, 0.75, 0.75, 1]


def revolved(profile: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Rational quadratic surface of revolution about z: (radius, z) profile control points."""
    ring = tensor(_SQUARE)[:, None]
    xy = ring * profile[None, :, :1]
    z = profile[None, :, 1:].expand(8, -1, 1)
    return torch.cat([xy, z], 2), tensor(_ROUND)[:, None] * weights[None]


def tunnel_points(seed: int, nu: int = 8, nv: int = 4, waves: float = 0.4) -> Tensor:
    angle = torch.arange(nu, dtype=F64) * 2 * math.pi / nu
    radius = 0.3 * (1 + waves * (random(seed, nu, nv) - 0.5))
    z = torch.linspace(0, 0.5, nv, dtype=F64).expand(nu, nv)
    x, y = radius * angle.cos()[:, None], radius * angle.sin()[:, None]
    return torch.stack([0.5 + x, 0.5 + y, z], 2)


def sampled_distance(surface: NurbsSurface, p: Tensor, low: float, high: float) -> Tensor:
    """Distance by sampling alone: a grid, then finer and finer ones around its best points."""
    u, v = torch.linspace(0, 1, 241, dtype=F64)[:-1], torch.linspace(low, high, 201, dtype=F64)
    uv = torch.cartesian_prod(u, v)
    d = torch.cdist(p, surface.point(uv).detach())
    best = torch.full((len(p),), math.inf, dtype=F64)
    fine = torch.cartesian_prod(*[torch.linspace(-1, 1, 21, dtype=F64)] * 2)
    for column in d.topk(12, largest=False).indices.T[::4]:
        center, width = uv[column], 2.0 * tensor([1 / 240, (high - low) / 200])
        for _ in range(9):
            t = center[:, None] + width * fine
            t[..., 1].clamp_(low, high)
            x = surface.point(t.reshape(-1, 2)).detach().reshape(*t.shape[:2], 3)
            near, which = (p[:, None] - x).norm(dim=2).min(1)
            center, width = t[torch.arange(len(p)), which], 0.3 * width
        best = torch.minimum(best, near)
    return best


@pytest.mark.reference
@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_basis_is_that_of_scipy(degree):
    num = 8
    u = random(0, 50)
    knots = np.concatenate([np.zeros(degree), np.linspace(0, 1, num - degree + 1), np.ones(degree)])
    values = SplineBasis(num, degree, periodic=False)(u)
    for order in range(3):
        if order > degree:
            continue
        for k in range(num):
            want = BSpline(knots, np.eye(num)[k], degree)(u.numpy(), nu=order)
            # second derivatives are of size num^2 degree^2
            np.testing.assert_allclose(values[order][:, k], want, atol=1e-11 * 100**order)
    around = SplineBasis(num, degree, periodic=True)
    torch.testing.assert_close(around(u), around(u + 3.0))
    torch.testing.assert_close(around(u)[0].sum(1), torch.ones(50, dtype=F64))
    shifted = around(u + 1 / num)[0].roll(-1, 1)
    torch.testing.assert_close(shifted, around(u)[0], atol=1e-13, rtol=0)


@pytest.mark.reference
@pytest.mark.parametrize("fluid", ["inside", "outside"])
def test_sphere_with_poles_is_exact(fluid):
    profile = tensor([[0, -1], [1, -1], [1, 0], [1, 1], [0, 1]])
    x, w = revolved(profile, tensor([1, _HALF, 1, _HALF, 1]))
    knots = (_KNOTS, [0, 0, 0, 0.5, 0.5, 1, 1, 1])
    ball = NurbsSurface(x, weights=w, degree=(2, 2), knots=knots, ends="stop", fluid=fluid)
    p = 4.0 * random(0, 500, 3) - 2.0
    axis = tensor([[0, 0, 1.3], [0, 0, 0.7], [0, 0, -1.2], [1e-9, 0, 1.1], [1e-4, 1e-4, -0.9]])
    p = torch.cat([p, axis]).requires_grad_()
    want = p.norm(dim=1) - 1.0
    want = want if fluid == "outside" else -want
    phi = ball(p)
    torch.testing.assert_close(phi, want, atol=1e-12, rtol=0)
    (grad,) = torch.autograd.grad(phi.sum(), p)
    (unit,) = torch.autograd.grad(want.sum(), p)
    torch.testing.assert_close(grad, unit, atol=1e-7, rtol=0)


@pytest.mark.reference
def test_spindle_with_a_sharp_rim_and_sharp_poles_is_exact():
    x, w = revolved(tensor([[0, 0], [0.3, 0.5], [0, 1.0]]), torch.ones(3, dtype=F64))
    spindle = NurbsSurface(
        x, weights=w, degree=(2, 1), knots=(_KNOTS, None), ends="stop", fluid="outside"
    )
    p = (random(5, 1000, 3) - 0.5) * tensor([1.4, 1.4, 2.0]) + tensor([0, 0, 0.5])
    r, z = torch.hypot(p[:, 0], p[:, 1]), p[:, 2]
    from_tip = torch.stack([r, torch.minimum(z, 1.0 - z)], 1)  # its halves mirror each other
    side = tensor([0.3, 0.5])
    t = (from_tip @ side / (side @ side)).clamp(0.0, 1.0)
    distance = (from_tip - t[:, None] * side).norm(dim=1)
    inside = (r < 0.6 * from_tip[:, 1]) & (from_tip[:, 1] > 0)
    # 1e-11: feet on the rim are held 1e-12 of the parameter beside it
    want = torch.where(inside, -distance, distance)
    torch.testing.assert_close(spindle(p), want, atol=1e-11, rtol=0)


@pytest.mark.reference
def test_torus_is_exact():
    profile = tensor([1.0, 0.0]) + 0.4 * tensor(_SQUARE)
    x, w = revolved(profile, tensor(_ROUND))
    ring = NurbsSurface(
        x,
        weights=w,
        degree=(2, 2),
        knots=(_KNOTS, _KNOTS),
        periodic=(True, True),
        fluid="outside",
    )
    as_near_all_around = random(2, 20, 1) * tensor([0.0, 0.0, 3.0])
    p = torch.cat([4.0 * random(1, 500, 3) - 2.0, as_near_all_around])
    want = torch.hypot(torch.hypot(p[:, 0], p[:, 1]) - 1.0, p[:, 2]) - 0.4
    torch.testing.assert_close(ring(p), want, atol=1e-12, rtol=0)


@pytest.mark.reference
def test_cylinder_goes_on_beyond_its_ends():
    x, w = revolved(tensor([[0.5, 0.0], [0.5, 1.0]]), tensor([1.0, 1.0]))
    tube = NurbsSurface(x, weights=w, degree=(2, 1), knots=(_KNOTS, None), fluid="inside")
    p = tensor([2.0, 2.0, 1.8]) * random(2, 300, 3) - tensor([1.0, 1.0, 0.4])
    p[-20:, :2] = 0.0  # as near all around
    want = 0.5 - torch.hypot(p[:, 0], p[:, 1])
    torch.testing.assert_close(tube(p), want, atol=1e-12, rtol=0)


@pytest.mark.reference
@pytest.mark.parametrize("rational", [False, True])
def test_distance_is_that_of_dense_sampling(rational):
    for seed in range(2):
        weights = 0.5 + random(50 + seed, 8, 4) if rational else None
        surface = NurbsSurface(tunnel_points(seed), weights=weights, ends="stop")
        p = tensor([1.0, 1.0, 0.6]) * random(10 + seed, 40, 3)
        want = sampled_distance(surface, p, 0.0, 1.0)
        torch.testing.assert_close(surface(p).abs(), want, atol=1e-8, rtol=0)


@pytest.mark.reference
def test_between_two_sheets_the_nearer_one_is_found():
    # a flat tunnel, coarsely sampled: the nearest sample is often on the farther sheet
    points = tunnel_points(14) * tensor([1.0, 0.3, 1.0])
    surface = BSplineSurface(points, ends="stop", samples=(4, 24))
    p = tensor([0.3, 0.006, 0.5]) * random(15, 150, 3) + tensor([0.35, 0.147, 0.0])
    want = sampled_distance(surface, p, 0.0, 1.0)
    torch.testing.assert_close(surface(p), want, atol=1e-8, rtol=0)


@pytest.mark.reference
def test_tangent_ends_against_dense_sampling():
    surface = BSplineSurface(tunnel_points(3))
    p = tensor([1.0, 1.0, 0.8]) * random(13, 40, 3) - tensor([0.0, 0.0, 0.15])
    want = sampled_distance(surface, p, -0.5, 1.5)
    torch.testing.assert_close(surface(p).abs(), want, atol=1e-8, rtol=0)
    polygon = surface(tensor([[0.5, 0.5, 0.0], [0.5, 0.5, 0.5], [0.95, 0.5, 0.2]]))
    assert (polygon.sign() == tensor([1, 1, -1])).all()


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        ((2, 24), r"at least 3 per span along u, which has 8, got \(2, 24\)"),
        ((3, 6), r"at least 24 per span along v, which has 1, got \(3, 6\)"),
    ],
)
def test_too_few_samples_are_refused(samples, message):
    """A plate of one span sampled by 2 and 6 was off by 9 % of its size, without a word."""
    with pytest.raises(ValueError, match=message):
        BSplineSurface(tunnel_points(3), samples=samples)
    assert BSplineSurface(tunnel_points(3), samples=(3, 24)).samples == (3, 24)


@pytest.mark.reference
@pytest.mark.parametrize("seed", range(4))
def test_the_fewest_samples_find_what_many_find(seed):
    line = torch.linspace(0, 1, 4, dtype=F64)
    x, y = torch.meshgrid(line, line, indexing="ij")
    plate = torch.stack([x, y, 0.8 * random(60 + seed, 4, 4)], 2)
    options = {"periodic": (False, False), "fluid": "front", "ends": "stop"}
    p = random(70 + seed, 200, 3)
    few, many = (BSplineSurface(plate, samples=(n, n), **options)(p).abs() for n in (24, 60))
    torch.testing.assert_close(few, many, atol=1e-12, rtol=0)


def test_band_changes_only_what_is_far():
    points, nodes = tunnel_points(4), grid_nodes((16, 16, 8), 1 / 16)
    exact = BSplineSurface(points)(nodes)
    near = BSplineSurface(points, band=0.1)(nodes)
    inside = exact.abs() < 0.1
    assert 0.1 < inside.double().mean() < 0.9
    torch.testing.assert_close(near[inside], exact[inside], atol=1e-13, rtol=0)
    assert (near.sign() == exact.sign()).all()
    excess = near.abs() - exact.abs()
    assert excess.min() > -1e-12 and excess.max() < 0.01


def test_on_the_surface_phi_is_zero_and_its_gradient_the_normal():
    surface = BSplineSurface(tunnel_points(5))
    p = surface.point(0.05 + 0.9 * random(6, 50, 2)).detach().requires_grad_()
    phi = surface(p)
    (grad,) = torch.autograd.grad(phi.sum(), p)
    assert phi.abs().max() < 1e-13
    torch.testing.assert_close(grad.norm(dim=1), torch.ones(50, dtype=F64))
    ahead = surface(p + 1e-6 * grad)
    torch.testing.assert_close(ahead, torch.full_like(phi, 1e-6), atol=1e-11, rtol=0)


def test_bottom_plate_and_lidded_obstacle():
    i, j = torch.meshgrid(torch.arange(5.0), torch.arange(6.0), indexing="ij")
    heights = 0.1 * random(8, 5, 6)
    plate = torch.stack([i / 4, j / 5, heights], 2).to(F64)
    bottom = BSplineSurface(plate, periodic=(False, False), fluid="front")
    assert bottom(tensor([0.5, 0.5, 0.6])).item() > 0.4
    assert bottom(tensor([-0.05, -0.05, -0.5])).item() < -0.4
    obstacle = BSplineSurface(tunnel_points(9), fluid="outside") | Plane((0, 0, 1), 0.4)
    p = tensor([[0.5, 0.5, 0.2], [0.5, 0.5, 0.45], [0.95, 0.95, 0.2]])
    assert (obstacle(p).sign() == tensor([-1, 1, 1])).all()


@pytest.mark.grad
@pytest.mark.parametrize("band", [None, 0.08])
def test_gradients_of_control_points_weights_and_points(band):
    points = tunnel_points(6, 5, 4).requires_grad_()
    weights = (0.8 + 0.4 * random(7, 5, 4)).requires_grad_()
    p = (tensor([1.0, 1.0, 0.5]) * random(8, 12, 3)).requires_grad_()

    def phi(c, w, x):
        return NurbsSurface(c, weights=w, band=band)(x)

    inputs = (points, weights, p)
    check_directions(phi, inputs, check_forward_ad=True)
    assert all(g.abs().max() > 0 for g in torch.autograd.grad(phi(*inputs).sum(), inputs))


def test_second_derivatives_raise():
    points = tunnel_points(1).requires_grad_()
    phi = BSplineSurface(points)(random(3, 5, 3))
    (grad,) = torch.autograd.grad(phi.sum(), points, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        grad.sum().backward()


def test_errors_say_what_to_do():
    points = tunnel_points(0)
    with pytest.raises(ValueError, match="at least 4 control points"):
        BSplineSurface(points[:, :3])
    with pytest.raises(ValueError, match="all be at one place"):
        BSplineSurface(torch.ones(8, 4, 3, dtype=F64))
    with pytest.raises(ValueError, match="fluid must be one of"):
        BSplineSurface(points, periodic=(False, False), fluid="inside")
    with pytest.raises(ValueError, match="knots must not fall"):
        BSplineSurface(points, knots=([0, 2, 1, 3, 4, 5, 6, 7, 8], None))
    with pytest.raises(ValueError, match="has no weights"):
        BSplineSurface(points, weights=torch.ones(8, 4, dtype=F64))
    with pytest.raises(ValueError, match="encloses nothing"):
        NurbsSurface(points * tensor([0.0, 1.0, 1.0]))


@pytest.mark.parametrize("spread", [1e3, 1e20, 1e300])
def test_weights_that_leave_the_others_nothing_are_refused(spread):
    x, w = tunnel_points(3), torch.ones(8, 4, dtype=F64)
    for where in ((2, 2), (2, slice(None))):
        for factor in (spread, 1.0 / spread):
            w = torch.ones(8, 4, dtype=F64)
            w[where] = factor
            with pytest.raises(ValueError, match="weights must lie"):
                NurbsSurface(x, weights=w)
    for size in (5e-324, 1e-300, 1e300):
        with pytest.raises(ValueError, match="weights must lie"):
            NurbsSurface(x, weights=size * torch.ones(8, 4, dtype=F64))
    surface = NurbsSurface(x, weights=torch.nn.Parameter(torch.ones(8, 4, dtype=F64)))
    with torch.no_grad():
        surface.weights[2] *= spread
    with pytest.raises(ValueError, match="weights must lie"):
        surface(random(1, 5, 3))


@pytest.mark.story  # dense sampling
@pytest.mark.reference
def test_weights_as_far_apart_as_allowed_against_dense_sampling():
    p = random(5, 100, 3)
    for where in ((2, 2), (2, slice(None)), (slice(None), 0)):
        for factor in (100.0, 0.01):
            w = torch.ones(8, 4, dtype=F64)
            w[where] = factor
            surface = NurbsSurface(tunnel_points(3), weights=w, ends="stop")
            missed = surface(p).detach().abs() - sampled_distance(surface, p, 0.0, 1.0)
            assert float(missed.max()) < 1e-9
