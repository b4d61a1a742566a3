"""The kernels of spline surfaces against scipy: its splines, its minimizer, and plain sorting."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.optimize import minimize
from torch import Tensor

from diffsim.stokes import _ops_surface
from diffsim.stokes.shapes import BSplineSurface, NurbsSurface
from diffsim.stokes.shapes.closest_surface import SurfaceSamples
from tests.helpers import random

F64 = torch.float64
CREASED = [0, 0, 0, 0, 0.3, 0.3, 0.3, 1, 1, 1, 1]  # cubic, with a kink at 0.3


def sheet(seed: int, heights: float = 1.0) -> Tensor:
    """7 x 7 control points over the unit square."""
    x, y = torch.meshgrid(*[torch.linspace(0, 1, 7, dtype=F64)] * 2, indexing="ij")
    return torch.stack([x, y, heights * random(seed, 7, 7)], 2)


def creased(seed: int, ends: str = "stop") -> NurbsSurface:
    """A rational sheet with a kink across each parameter."""
    return NurbsSurface(
        sheet(seed),
        weights=0.5 + random(seed + 50, 7, 7),
        knots=(CREASED, CREASED),
        periodic=(False, False),
        fluid="front",
        ends=ends,
    )


def tube(seed: int) -> NurbsSurface:
    """A wavy tunnel, periodic around its axis."""
    angle = 2.0 * math.pi / 8 * torch.arange(8, dtype=F64)[:, None]
    radius = 0.2 + 0.1 * random(seed, 8, 5)
    z = torch.linspace(0, 1, 5, dtype=F64).expand(8, 5)
    points = torch.stack([radius * angle.cos(), radius * angle.sin(), z], 2)
    return NurbsSurface(points, weights=0.5 + random(seed + 50, 8, 5), degree=(3, 2))


class ScipySurface:
    """A surface by scipy's splines of the homogeneous control points; u around where periodic."""

    def __init__(self, surface: NurbsSurface, knots_v: list[float]):
        h = surface._patch().homogeneous.numpy()
        (p, self.q), num = (b.degree for b in surface.bases), len(h)
        if surface.bases[0].periodic:
            knots_u = (np.arange(num + 2 * p + 1) - p) / num
            h = h[np.arange(num + p) % num]
        else:
            knots_u = np.array(CREASED, dtype=float)
        self.along_u = BSpline(knots_u, h, p)
        self.knots_v = np.array(knots_v, dtype=float)

    def homogeneous(self, u: float, v: float, du: int, dv: int) -> np.ndarray:
        return BSpline(self.knots_v, self.along_u(u, nu=du), self.q)(v, nu=dv)

    def frame(self, u: float, v: float) -> np.ndarray:
        """S, S_u, S_v, (3, 3); beyond [0, 1] the homogeneous surface goes on straight along v."""
        inside = min(max(v, 0.0), 1.0)
        a, au, av, auv = (
            self.homogeneous(u, inside, *order) for order in ((0, 0), (1, 0), (0, 1), (1, 1))
        )
        a, au = a + (v - inside) * av, au + (v - inside) * auv
        s = a[:3] / a[3]
        return np.stack([s, (au[:3] - au[3] * s) / a[3], (av[:3] - av[3] * s) / a[3]])

    def distance(self, p: np.ndarray, pieces: list[tuple[float, float]]) -> float:
        """Least distance: in each piece from its two best samples, by L-BFGS-B within bounds."""

        def half_square(x: np.ndarray) -> tuple[float, np.ndarray]:
            s, su, sv = self.frame(*x)
            return 0.5 * (s - p) @ (s - p), np.array([(s - p) @ su, (s - p) @ sv])

        best = math.inf
        for u0, u1 in pieces:
            for v0, v1 in pieces:
                u, v = np.linspace(u0, u1, 12), np.linspace(v0, v1, 12)
                rows = BSpline(self.knots_v, self.along_u(u).swapaxes(0, 1), self.q)(v)
                square = ((rows[..., :3] / rows[..., 3:] - p) ** 2).sum(2)
                for k in np.argsort(square, axis=None)[[0, 5]]:
                    start = [u[k % 12], v[k // 12]]
                    found = minimize(
                        half_square,
                        start,
                        jac=True,
                        method="L-BFGS-B",
                        bounds=[(u0, u1), (v0, v1)],
                        options={"ftol": 1e-16, "gtol": 1e-9},
                    )
                    best = min(best, math.sqrt(2.0 * found.fun))
        return best


def arguments(surface: NurbsSurface, p: Tensor, **changed: Any) -> dict[str, Any]:
    """Arguments of the op, one thread."""
    patch = surface._patch()
    samples = SurfaceSamples(patch, surface.samples, 0.5)
    given = {
        "points": p,
        **patch._arrays(),
        "sample_uv": samples.uv,
        "sample_points": samples.points,
        "gap": samples.gap,
        "band": math.inf,
        "num_threads": 1,
    }
    return {**given, **changed}


@pytest.mark.reference
def test_frames_are_those_of_scipy():
    for surface, knots_v in ((creased(0), CREASED), (tube(1), [0, 0, 0, 1 / 3, 2 / 3, 1, 1, 1])):
        other = ScipySurface(surface, knots_v)
        uv = random(2, 40, 2)
        if surface.bases[0].periodic:
            uv = uv * torch.tensor([1.0, 1.4], dtype=F64) - torch.tensor([0.0, 0.2], dtype=F64)
        want = np.stack([other.frame(u, v) for u, v in uv.tolist()])
        turns = torch.tensor([3.0 if surface.bases[0].periodic else 0.0, 0.0], dtype=F64)
        for parameters in (uv, uv - turns):
            frames = torch.stack(surface._patch().derivatives(parameters), 1)
            np.testing.assert_allclose(frames, want, atol=2e-12)


@pytest.mark.reference
def test_distance_to_a_creased_sheet_is_that_of_a_minimizer():
    surface = creased(3)
    other, p = ScipySurface(surface, CREASED), 1.6 * random(4, 40, 3) - 0.3
    phi = surface(p).abs()
    want = [other.distance(each, [(0.0, 0.3), (0.3, 1.0)]) for each in p.numpy()]
    np.testing.assert_allclose(phi, want, atol=1e-9)
    uv, _ = surface._patch().closest(SurfaceSamples(surface._patch(), (6, 6), 0.5), p, None)
    assert ((uv - 0.3).abs() < 1e-11).any(1).sum() > 5  # some feet lie on a kink


@pytest.mark.reference
@pytest.mark.parametrize("height", [0.02, 0.2])
def test_folds_closer_than_samples_are_told_apart(height):
    # a folded sheet: above a valley the feet on its two sides lie within a sample or two
    x, y = torch.meshgrid(*[torch.linspace(0, 1, 6, dtype=F64)] * 2, indexing="ij")
    z = height * torch.tensor([0.0, 1.0, 0.0, 1.0, 0.0, 1.0], dtype=F64)[:, None].expand(6, 6)
    options = {"degree": (1, 1), "periodic": (False, False), "fluid": "front", "ends": "stop"}
    folded = BSplineSurface(torch.stack([x, y, z], 2), samples=(2, 2), **options)
    p = random(7, 2000, 3) * torch.tensor([1.0, 1.0, 0.3], dtype=F64)
    a, b = folded.control_points[:-1, 0, ::2], folded.control_points[1:, 0, ::2]
    q = p[:, None, ::2]
    t = (((q - a) * (b - a)).sum(2) / ((b - a) ** 2).sum(1)).clamp(0.0, 1.0)
    want = (q - a - t[..., None] * (b - a)).norm(dim=2).amin(1)
    torch.testing.assert_close(folded(p).abs(), want, atol=2e-12, rtol=0)


@pytest.mark.reference
def test_beyond_the_band_stands_the_nearest_sample_the_first_of_equals():
    x, y = torch.meshgrid(*[torch.linspace(0, 1, 7, dtype=F64)] * 2, indexing="ij")
    flat = torch.stack([x, y, torch.zeros_like(x)], 2)
    options = {"degree": (1, 1), "periodic": (False, False), "fluid": "front", "ends": "stop"}
    surface = BSplineSurface(flat, samples=(2, 2), **options)
    between = (torch.cartesian_prod(torch.arange(12), torch.arange(12)).to(F64) + 0.5) / 12
    between = torch.cat([between, torch.full((144, 1), 0.5, dtype=F64)], 1)
    p = torch.cat([between, 3.0 * random(5, 300, 3) - 1.0 + torch.tensor([0.0, 0.0, 2.0])])
    given = arguments(surface, p, band=0.0)
    uv, slope = _ops_surface.closest_on_surface(**given)
    points = given["sample_points"].reshape(-1, 3)
    square = ((p[:, None] - points) ** 2).sum(2)
    nearest = square <= square.amin(1, keepdim=True) + 1e-15
    assert (nearest.sum(1) == 4).sum() >= 144  # in the middle of four samples
    uv_at = given["sample_uv"].reshape(-1, 2)
    is_one = (uv[:, None] == uv_at).all(2)
    assert (is_one & nearest).any(1).all() and not slope.any()
    again, _ = _ops_surface.closest_on_surface(**{**given, "points": p.flip(0).contiguous()})
    assert torch.equal(again.flip(0), uv)


@pytest.mark.property
def test_the_same_bits_on_any_number_of_threads():
    p = 1.6 * random(6, 2000, 3) - 0.3
    for surface in (creased(3, ends="tangent"), tube(4)):
        one = _ops_surface.closest_on_surface(**arguments(surface, p))
        for num_threads in (2, 3):
            more = _ops_surface.closest_on_surface(**arguments(surface, p, num_threads=num_threads))
            assert all(torch.equal(a, b) for a, b in zip(one, more, strict=True))


def ordered(op, given):
    return tuple(given[name] for name in op.arguments)


def test_the_ops_are_ops():
    given = arguments(tube(5), random(8, 3, 3))
    torch.library.opcheck(
        _ops_surface.closest_on_surface.op, ordered(_ops_surface.closest_on_surface, given)
    )
    frames = _ops_surface.surface_frames
    torch.library.opcheck(frames.op, ordered(frames, given | {"uv": random(9, 3, 2)}))
    no_points = _ops_surface.closest_on_surface(**{**given, "points": random(8, 0, 3)})
    assert [t.shape for t in no_points] == [(0, 2), (0,)]


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"points": random(1, 3, 2)}, ValueError, "points must have shape"),
        ({"points": random(1, 3, 3).float()}, TypeError, "points must be a torch.float64"),
        ({"points": math.nan * random(1, 3, 3)}, ValueError, "points must be finite"),
        ({"sample_uv": random(1, 4, 4, 2)}, ValueError, "sample_points must have shape"),
        ({"homogeneous": random(1, 8, 5, 3)}, ValueError, "homogeneous must have shape"),
        ({"breaks_u": random(1, 3)}, ValueError, "breaks of u must be one more"),
        ({"coefficients_u": random(1, 8, 9, 9)}, ValueError, r"degree must lie in \[1, 5\]"),
        ({"first_u": torch.full((8,), 8)}, ValueError, r"lie in \[0, 7\]"),
        ({"low": [0.0, -math.inf]}, ValueError, "low must be below high"),
    ],
)
def test_what_the_kernel_cannot_read_is_refused(changed, error, message):
    with pytest.raises(error, match=message):
        _ops_surface.closest_on_surface(**{**arguments(tube(5), random(8, 3, 3)), **changed})
