"""Bezier walls against dense sampling, circles, and finite differences."""

import math
import warnings

import pytest
import torch
from torch import Tensor

from diffsim.stokes import _ops_curve
from diffsim.stokes.shapes import BezierCurve2d
from tests.gradients import check_directions
from tests.helpers import random, tensor

F64 = torch.float64
_HALF = math.sqrt(0.5)


def quiet(*args, **options) -> BezierCurve2d:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return BezierCurve2d(*args, **options)


def sampled_distance(curve: BezierCurve2d, p: Tensor, num_curves: int = 1) -> Tensor:
    """Distance by sampling alone: 4000 points, then each of the three best ones 2 x 200 more."""
    tau = torch.linspace(0, num_curves, 4001, dtype=F64)
    fine = torch.linspace(-1, 1, 201, dtype=F64)
    best = torch.full((len(p),), math.inf, dtype=F64)
    d = torch.cdist(p, curve.point(tau).detach())
    lower = (d[:, 1:-1] <= d[:, :-2]) & (d[:, 1:-1] <= d[:, 2:])  # all local minima, and the ends
    lower = torch.nn.functional.pad(lower, (1, 1), value=True)
    starts = torch.where(lower, d, math.inf).topk(3, largest=False).indices
    for column in starts.T:
        center, width = tau[column], float(tau[1])
        for _ in range(3):
            t = (center[:, None] + width * fine).clamp(0, num_curves)
            x = curve.point(t.flatten()).detach().reshape(*t.shape, 2)
            near, which = (p[:, None] - x).norm(dim=2).min(1)
            center, width = t.gather(1, which[:, None])[:, 0], 2 * width / 200
        best = torch.minimum(best, near)
    return best


def circle(radius: float = 1.0, **options) -> BezierCurve2d:
    x = [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]]
    weights = tensor([1, _HALF] * 4)
    return BezierCurve2d(
        radius * tensor(x), weights=weights, degree=2, closed=True, **{"fluid": "inside", **options}
    )


@pytest.mark.reference
@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5, 8])
def test_distance_is_that_of_dense_sampling(degree):
    for seed in range(3):
        curve = quiet(random(seed, degree + 1, 2), ends="stop")
        p = 2.0 * random(100 + seed, 100, 2) - 0.5
        # 1e-9: the samples' last spacing is 1e-8 of the curve, and the distance is flat there
        torch.testing.assert_close(curve(p).abs(), sampled_distance(curve, p), atol=1e-9, rtol=0)


@pytest.mark.reference
@pytest.mark.parametrize("repeated", [(0, 0), (0, 1), (2, 3), (1, 2)])
def test_repeated_and_almost_straight_control_points(repeated):
    points = tensor([[0.0, 0.1], [0.3, 0.1 + 1e-9], [0.6, 0.1], [1.0, 0.1 + 1e-7]])
    points[repeated[1]] = points[repeated[0]]
    curve = BezierCurve2d(points, ends="stop")
    p = 2.0 * random(5, 100, 2) - 0.5
    torch.testing.assert_close(curve(p).abs(), sampled_distance(curve, p), atol=1e-9, rtol=0)
    side = BezierCurve2d(points)(p)
    assert ((side > 0) == (p[:, 1] > 0.1)).all()


@pytest.mark.reference
def test_weighted_curves_and_chains_against_dense_sampling():
    curve = quiet(random(1, 4, 2), weights=0.2 + 3.0 * random(2, 4), ends="stop")
    p = 2.0 * random(3, 100, 2) - 0.5
    torch.testing.assert_close(curve(p).abs(), sampled_distance(curve, p), atol=1e-9, rtol=0)
    chain = quiet(random(4, 7, 2), degree=3, ends="stop")
    torch.testing.assert_close(chain(p).abs(), sampled_distance(chain, p, 2), atol=1e-9, rtol=0)
    loop = quiet(random(4, 6, 2), degree=3, closed=True)
    torch.testing.assert_close(loop(p).abs(), sampled_distance(loop, p, 2), atol=1e-9, rtol=0)


@pytest.mark.reference
@pytest.mark.parametrize("fluid", ["inside", "outside"])
def test_rational_quadratics_are_a_circle(fluid):
    p = 4.0 * random(0, 500, 2) - 2.0
    p = torch.cat([p, torch.zeros(1, 2, dtype=F64), 1.5 * p / p.norm(dim=1, keepdim=True)])
    want = 1.5 - p.norm(dim=1)
    want = want if fluid == "inside" else -want
    torch.testing.assert_close(circle(1.5, fluid=fluid)(p), want, atol=1e-12, rtol=0)


def test_sides_do_not_depend_on_the_direction_of_travel():
    points = tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    p = 2.0 * random(7, 200, 2) - 0.5
    for fluid in ("inside", "outside"):
        one = BezierCurve2d(points, degree=1, closed=True, fluid=fluid)(p)
        other = BezierCurve2d(points.flip(0), degree=1, closed=True, fluid=fluid)(p)
        torch.testing.assert_close(one, other)
    assert BezierCurve2d(points, degree=1, closed=True, fluid="inside")(tensor([[0.5, 0.5]])) > 0
    left = BezierCurve2d(points[:2], fluid="left")
    assert left(tensor([0.5, 0.2])) == pytest.approx(0.2)
    assert BezierCurve2d(points[:2], fluid="right")(tensor([0.5, 0.2])) == pytest.approx(-0.2)


@pytest.mark.reference
def test_corners_have_the_distance_and_sign_of_a_polygon():
    # acute and reflex corners: the side there is that of both edges, not of one
    corners = tensor([[0, 0], [2, 0.2], [0.3, 0.5], [2, 0.8], [0, 1]])
    loop = BezierCurve2d(corners, degree=1, closed=True, fluid="inside")
    p = tensor([2.6, 1.6]) * random(8, 1000, 2) - 0.3
    a, b = corners, corners.roll(-1, 0)
    t = ((p[:, None] - a) * (b - a)).sum(2) / (b - a).square().sum(1)
    foot = a + t.clamp(0, 1)[..., None] * (b - a)
    distance = (p[:, None] - foot).norm(dim=2).amin(1)
    crosses = (a[:, 1] > p[:, None, 1]) != (b[:, 1] > p[:, None, 1])
    at = a[:, 0] + (p[:, None, 1] - a[:, 1]) / (b - a)[:, 1] * (b - a)[:, 0]
    inside = (crosses & (p[:, None, 0] < at)).sum(1) % 2 == 1
    want = torch.where(inside, distance, -distance)
    torch.testing.assert_close(loop(p), want, atol=1e-12, rtol=0)


def test_cusp_has_the_side_of_its_branches():
    # (t^2, t^3) in disguise: comes from the lower right, turns at the origin, leaves to the right
    cusp = tensor([[1, -1], [-1 / 3, 1], [-1 / 3, -1], [1, 1]])
    curve = quiet(cusp, fluid="left")
    middle = float(curve.point(tensor([0.5]))[0, 0])
    p = tensor([[middle - 0.3, 0.0], [middle - 0.3, 0.05], [middle - 0.3, -0.05]])
    assert (curve(p) > 0).all()
    assert curve(p[:1]).item() == pytest.approx(0.3, abs=1e-12)
    assert curve(tensor([0.9, 0.0])).item() < 0
    tip = tensor([[middle, 0.0]]).requires_grad_()
    phi = curve(tip)
    (grad,) = torch.autograd.grad(phi.sum(), tip)
    assert abs(phi.item()) < 1e-12 and bool(torch.isfinite(grad).all())


def test_open_ends_go_on_along_their_tangents_or_stop():
    points = tensor([[0, 0], [0.5, 0], [1, 1]])
    p = tensor([[-2.0, 0.3], [-2.0, -0.3], [2.0, 2.5]])
    slope = (p[2] - tensor([1, 1])) @ tensor([-2, 1]) / math.sqrt(5)
    torch.testing.assert_close(BezierCurve2d(points)(p), tensor([0.3, -0.3, slope]))
    stop = BezierCurve2d(points, ends="stop")(p)
    far = (p - tensor([[0, 0], [0, 0], [1, 1]])).norm(dim=1)
    torch.testing.assert_close(stop, far * tensor([1, -1, 1 if slope > 0 else -1]))


def test_on_the_curve_phi_is_zero_and_its_gradient_the_normal():
    curve = BezierCurve2d(tensor([[0, 0.1], [0.3, 0.1], [0.6, 0.5], [1, 0.3]]))
    tau = torch.linspace(0, 1, 33, dtype=F64)
    p = curve.point(tau).detach().requires_grad_()
    phi = curve(p)
    (grad,) = torch.autograd.grad(phi.sum(), p)
    assert phi.abs().max() < 1e-14
    torch.testing.assert_close(grad.norm(dim=1), torch.ones(33, dtype=F64))
    step = 1e-7
    torch.testing.assert_close(
        curve(p + step * grad), torch.full_like(phi, step), atol=1e-12, rtol=0
    )


def test_of_two_equally_near_points_the_first_is_taken():
    wall = tensor([[-1.0, 1.0], [0.0, -1.0], [1.0, 1.0]]).requires_grad_()
    p = tensor([[0.0, 0.9]])
    grads = [torch.autograd.grad(BezierCurve2d(wall)(p).sum(), wall)[0] for _ in range(2)]
    assert torch.equal(*grads)
    assert float(BezierCurve2d(wall.detach()).closest(p)) < 0.5


@pytest.mark.grad
@pytest.mark.parametrize("ends", ["tangent", "stop"])
def test_gradients_of_control_points_and_points(ends):
    points = random(11, 4, 2).requires_grad_()
    p = (2.0 * random(12, 8, 2) - 0.5).requires_grad_()
    assert torch.autograd.gradcheck(lambda c, x: quiet(c, ends=ends)(x), (points, p))


@pytest.mark.grad
def test_gradients_of_weights_loops_and_forward_mode():
    points = tensor([[0, 0], [1, -0.2], [1.2, 0.6], [0.8, 1.3], [0.1, 1], [-0.4, 0.5]])
    weights = (0.5 + random(13, 6)).requires_grad_()
    p = (1.6 * random(14, 12, 2) - 0.3).requires_grad_()

    def phi(c, w, x):
        return BezierCurve2d(c, weights=w, degree=2, closed=True, fluid="inside")(x)

    inputs = (points.requires_grad_(), weights, p)
    check_directions(phi, inputs, check_forward_ad=True)
    assert all(g.abs().max() > 0 for g in torch.autograd.grad(phi(*inputs).sum(), inputs))


def test_second_derivatives_raise():
    p = random(3, 5, 2).requires_grad_()
    (grad,) = torch.autograd.grad(circle()(p).sum(), p, create_graph=True)
    with pytest.raises(RuntimeError, match="second derivatives"):
        grad.sum().backward()


def test_parameters_changed_in_place_are_used():
    points = torch.nn.Parameter(tensor([[0, 0], [1, 0]]))
    wall = BezierCurve2d(points)
    assert [id(q) for q in wall.parameters()] == [id(points)]
    with torch.no_grad():
        points += 0.25
    assert wall(tensor([0.5, 1.0])).item() == pytest.approx(0.75)
    with torch.no_grad():
        points[0, 0] = math.nan
    with pytest.raises(ValueError, match="control_points must be finite"):
        wall(tensor([0.5, 1.0]))


def test_errors_say_what_to_do():
    with pytest.raises(ValueError, match="degree x n \\+ 1"):
        BezierCurve2d(random(0, 5, 2), degree=3)
    with pytest.raises(ValueError, match="all be at one place"):
        BezierCurve2d(torch.ones(4, 2, dtype=F64))
    with pytest.raises(ValueError, match="fluid must be one of"):
        BezierCurve2d(random(0, 3, 2), fluid="inside")
    with pytest.raises(ValueError, match="encloses no area"):
        BezierCurve2d(tensor([[0, 0], [1, 1], [2, 2]]), degree=1, closed=True, fluid="inside")
    eight = tensor([[0, 0], [1, 1], [1, 0], [0, 1.5]])
    with pytest.warns(UserWarning, match="crosses itself near"):
        BezierCurve2d(eight, degree=1, closed=True)


def test_the_op_of_closest_points():
    curve = quiet(random(21, 4, 2), weights=0.5 + random(22, 4))
    chain, rays = curve._chain(), curve._rays()
    args = (random(23, 5, 2), chain.homogeneous, rays, chain.closed, chain.size)
    torch.library.opcheck(_ops_curve.closest_on_curves.op, args)
    with pytest.raises(TypeError, match="float64"):
        _ops_curve.closest_on_curves(args[0].float(), *args[1:])


@pytest.mark.parametrize("weights", [None, tensor([1.0, 0.5, 2.0, 1.0])])
def test_parameters_of_points_beside_the_curve_are_found_to_rounding(weights):
    curve = BezierCurve2d(
        tensor([[0, 0.1], [0.3, 0.1], [0.6, 0.5], [1, 0.3]]), weights=weights, ends="stop"
    )
    tau = torch.linspace(0.01, 0.99, 200, dtype=F64)
    on = curve.point(tau).detach().requires_grad_()
    (normal,) = torch.autograd.grad(curve(on).sum(), on)
    for offset in (-0.02, 0.03):
        torch.testing.assert_close(
            curve.closest(on.detach() + offset * normal), tau, atol=1e-13, rtol=0
        )


@pytest.mark.parametrize("seed", range(6))
def test_side_behind_an_end_with_repeated_control_points(seed):
    """Where a curve starts at rest, rounding must not choose its direction."""
    points, p = random(seed, 9, 2), 3.0 * random(20 + seed, 400, 2) - 1.0
    points[1] = points[0]
    curve = quiet(points, weights=0.2 + random(40 + seed, 9), ends="stop")
    at_start = curve.closest(p) == 0
    x, y = (points[2] - points[0]).tolist()
    away = (p - points[0])[at_start]
    across = (x * away[:, 1] - y * away[:, 0]) / (math.hypot(x, y) * away.norm(dim=1))
    clear = across.abs() > 1e-3
    assert clear.sum() > 20
    assert ((curve(p)[at_start] > 0) == (across > 0))[clear].all()


def test_normals_of_rational_curves_are_square_to_the_curve():
    """Its slope is (h' - x w') / w: a normal without the weights' term leans, the foot is right."""
    points = tensor([[0.0, 0.0], [0.3, 0.9], [0.9, -0.5], [1.0, 0.2]])
    curve = quiet(points, weights=tensor([1.0, 3.0, 0.4, 2.0]))
    p = random(3, 40, 2)
    tau, normal = curve._chain().closest(p, None)
    inner = (tau > 1e-3) & (tau < 1.0 - 1e-3)
    assert int(inner.sum()) > 20
    step = 1e-6
    along = curve.point((tau + step)[inner]) - curve.point((tau - step)[inner])
    cosine = (normal[inner] * along).sum(1) / along.norm(dim=1)
    assert float(cosine.abs().max()) < 1e-6  # differences have 1e-10 of the slope


@pytest.mark.parametrize("spread", [1e5, 1e20, 1e300])
def test_weights_that_leave_the_others_nothing_are_refused(spread):
    points = tensor([[0, 0.1], [0.3, 0.1], [0.6, 0.5], [1, 0.3]])
    for factor in (spread, 1.0 / spread):
        with pytest.raises(ValueError, match="weights must lie"):
            quiet(points, weights=tensor([1.0, factor, 1.0, 1.0]), ends="stop")
    for size in (5e-324, 1e-300, 1e300):
        with pytest.raises(ValueError, match="weights must lie"):
            quiet(points, weights=tensor([size] * 4), ends="stop")
