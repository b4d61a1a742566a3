"""Tunnels and obstacles in space: signed distance to spline surfaces, phi > 0 in the fluid."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from diffsim.core.check import require, require_choice, require_number, require_range
from diffsim.core.checked import checked
from diffsim.core.errors import ConvergenceWarning
from diffsim.core.numbers import require_unmapped
from diffsim.core.record import warn
from diffsim.stokes.shapes.base import Shape, require_weights
from diffsim.stokes.shapes.closest_surface import SurfacePatch, SurfaceSamples
from diffsim.stokes.shapes.envelope import signed_distance
from diffsim.stokes.shapes.spline_basis import SplineBasis

_SAMPLES = 48  # at least, along each parameter
_PER_SPAN = 6  # at least
_LEAST_SAMPLES = 24  # 1 of 156 drawn surfaces missed a point, by 5e-5; of 16 samples 4, by 4e-3
_REACH = 0.5  # parameter length by which the surface goes on beyond an open end
_MOST_RATIO = 100.0  # of weights: at 1000 the samples missed nearest points by 1 % of the size
_ASIDE = 1e-5  # parameter distance at which normals beside an edge are taken
_NOT_STATIONARY = 1e-4


class NurbsSurface(Shape):
    """Signed distance to a B-spline (weights None) or NURBS surface; phi > 0 in the fluid.

    u is periodic and v open for tunnels (fluid inside, the thesis's twister) and obstacles around
    an axis (fluid outside, its switch); both periodic for rings; both open for bottom plates. At an
    open end the surface goes on along its tangents by half its parameter length
    (``ends="tangent"``), so that the nodes at the domain's border have a side, or it stops. A row
    of control points at one place makes a pole (with ``ends="stop"``); flat lids come from
    ``tube | Plane(...)``.

    The closest point is the best of up to three searches, six where there are kinks: from the
    nearest of many samples and from the nearest ones on other sheets; it is stationary to rounding,
    or on a kink (a knot repeated ``degree`` times). phi is then exact, and so are its gradients
    with respect to control points, weights and points. On the medial axis, where sheets are equally
    near, one is taken, the same at every call; there, far from a wavy surface, a better one can be
    missed (measured: by 1e-5 of the size at 1 of 20000 nodes; more ``samples`` help).
    Self-intersections are not looked for.

    Args:
        control_points: Control points, (nu, nv, 3) float64 [m]; periodic directions do not repeat
            the first.
        fluid: Side of the fluid: "inside" or "outside" (u periodic), "front", which is the side of
            S_u x S_v, or "back".
        weights: Weights of the control points, (nu, nv), > 0, the largest at most 100 times the
            smallest.
        degree: Degree in u and v, 1 to 5.
        periodic: Whether u and v wrap.
        knots: Knots of u and v, as in ``SplineBasis``; uniform where None.
        ends: How open ends go on: along the "tangent", or not ("stop").
        band: Distance [m] within which phi is exact; farther away it is the distance to the nearest
            sample: right sign, at most a sample's spacing too large, gradients to match. A few
            cells are enough for the flow. None: exact everywhere.
        samples: Samples per knot span in u and v; at least 2, and 24 in all along a parameter
            whose degree is not 1. By default 6 and 48 in all, at least.

    Raises:
        ValueError: wrong counts, NaN, all control points at one place, no inside.
    """

    dim = 3

    def __init__(
        self,
        control_points: Tensor,
        *,
        fluid: str = "inside",
        weights: Tensor | None = None,
        degree: tuple[int, int] = (3, 3),
        periodic: tuple[bool, bool] = (True, False),
        knots: tuple[Sequence[float] | None, Sequence[float] | None] = (None, None),
        ends: str = "tangent",
        band: float | None = None,
        samples: tuple[int, int] | None = None,
    ):
        super().__init__()
        self.control_points = require("control_points", control_points, ("nu", "nv", 3))
        num = control_points.shape[:2]
        self.weights = None
        if weights is not None:
            self.weights = require_weights(weights, num, _MOST_RATIO)
        extend = require_choice("ends", ends, ("tangent", "stop")) == "tangent"
        u, v = (
            SplineBasis(n, d, periodic=bool(c), knots=k, extend=extend)
            for n, d, c, k in zip(num, degree, periodic, knots, strict=True)
        )
        self.bases = (u, v)
        sides = ("inside", "outside", "front", "back") if u.periodic else ("front", "back")
        self.fluid = require_choice("fluid", fluid, sides)
        self.band = None if band is None else require_number("band", band, above=0.0)
        if samples is None:
            counts = [max(_PER_SPAN, math.ceil(_SAMPLES / (len(b.breaks) - 1))) for b in self.bases]
            samples = (counts[0], counts[1])
        self.samples = self._require_samples(samples)
        require_unmapped(**self._shape())
        require_range("control_points", control_points, at_least=-1e100, at_most=1e100)
        self._side(self._patch())

    def _require_samples(self, samples: tuple[int, int]) -> tuple[int, int]:
        """Refuse too few for searches to begin near every foot; lines of degree 1 have one foot."""
        for name, basis, count in zip("uv", self.bases, samples, strict=True):
            spans = len(basis.breaks) - 1
            least = 2 if basis.degree == 1 else max(2, math.ceil(_LEAST_SAMPLES / spans))
            if count < least:
                raise ValueError(
                    f"samples must be at least {least} per span along {name}, which has {spans}, "
                    f"got {samples}: with fewer, nearest points are missed"
                )
        return samples

    def _shape(self) -> dict[str, Tensor]:
        weights = {} if self.weights is None else {"weights": self.weights}
        return {"control_points": self.control_points, **weights}

    @checked(uv=("N", 2))
    def point(self, uv: Tensor) -> Tensor:
        """Points (N, 3) of the surface, uv (N, 2) in [0, 1]; gradients: shape."""
        h = self._homogeneous()
        nu, nv, num = h.shape
        bu, bv = self.bases[0](uv[:, 0], 0)[0], self.bases[1](uv[:, 1], 0)[0]
        rows = (bu @ h.reshape(nu, nv * num)).reshape(-1, nv, num)
        a = (bv[:, None] @ rows)[:, 0]
        return a if num == 3 else a[:, :3] / a[:, 3:]

    @checked
    def mesh(self, num: tuple[int, int] = (64, 64)) -> tuple[Tensor, Tensor]:
        """Quadrilaterals for pictures: points (P, 3) and faces (F, 4) along S_u x S_v."""
        sizes = [n if b.periodic else n + 1 for n, b in zip(num, self.bases, strict=True)]
        u, v = (torch.arange(m, dtype=torch.float64) / n for m, n in zip(sizes, num, strict=True))
        i, j = torch.cartesian_prod(torch.arange(num[0]), torch.arange(num[1])).unbind(1)
        i2, j2 = (i + 1) % sizes[0], (j + 1) % sizes[1]
        corners = [i * sizes[1] + j, i2 * sizes[1] + j, i2 * sizes[1] + j2, i * sizes[1] + j2]
        return self.point(torch.cartesian_prod(u, v)), torch.stack(corners, 1)

    def level(self, points: Tensor) -> Tensor:
        require_unmapped(points=points, **self._shape())
        p, patch = points.detach(), self._patch()
        samples = SurfaceSamples(patch, self.samples, _REACH)
        uv, slope = patch.closest(samples, p, self.band)
        foot = self.point(uv)
        normal = self._normal(patch, uv, p - foot.detach(), slope)
        return signed_distance(points, foot, self._side(patch) * normal)

    def _homogeneous(self) -> Tensor:
        if self.weights is None:
            return self.control_points
        w = self.weights[:, :, None]
        return torch.cat([w * self.control_points, w], 2)

    def _patch(self) -> SurfacePatch:
        x = require("control_points", self.control_points.detach(), ("nu", "nv", 3))
        extent = float((x.amax((0, 1)) - x.amin((0, 1))).max())
        if not extent > 1e-12 * float(x.abs().max()):
            raise ValueError(f"control_points must not all be at one place, {x[0, 0].tolist()}")
        w = torch.ones(x.shape[:2], dtype=torch.float64) if self.weights is None else self.weights
        w = require_weights(w.detach(), x.shape[:2], _MOST_RATIO)[:, :, None]
        range_ = [self._range(w, k) for k in (0, 1)]
        low, high = (torch.tensor(r, dtype=torch.float64) for r in zip(*range_, strict=True))
        return SurfacePatch(torch.cat([w * x, w], 2), self.bases, low, high, extent)

    def _range(self, w: Tensor, axis: int) -> tuple[float, float]:
        """Parameters allowed; beyond an end only as far as the weights stay well above zero."""
        basis = self.bases[axis]
        if basis.periodic:
            return -math.inf, math.inf
        if not basis.extend:
            return 0.0, 1.0
        value, slope = basis(torch.tensor([0.0, 1.0], dtype=torch.float64), 1)
        w = w[:, :, 0] if axis == 0 else w[:, :, 0].T
        falls = (slope @ w) * torch.tensor([[1.0], [-1.0]]) / (value @ w)  # away from the ends
        low, high = (0.5 / falls.clamp(min=1e-300).amax(1)).clamp(max=_REACH).tolist()
        return -low, 1.0 + high

    def _side(self, patch: SurfacePatch) -> float:
        """1 where the fluid is in front (the side of S_u x S_v)."""
        if self.fluid in ("front", "back"):
            return 1.0 if self.fluid == "front" else -1.0
        u = torch.arange(_SAMPLES, dtype=torch.float64) / _SAMPLES
        v = (torch.arange(_SAMPLES, dtype=torch.float64) + 0.5) / _SAMPLES
        s, su, sv = patch.derivatives(torch.cartesian_prod(u, v))
        rings = s.reshape(_SAMPLES, _SAMPLES, 3)
        away = (rings - rings.mean(0)).reshape(-1, 3)
        flux = (away * torch.linalg.cross(su, sv)).sum(1)
        scale = (away.norm(dim=1) * su.norm(dim=1) * sv.norm(dim=1)).sum()
        if float(flux.sum().abs()) <= 1e-9 * float(scale):
            raise ValueError("the surface encloses nothing: inside and outside are not defined")
        front_is_outside = float(flux.sum()) > 0
        return 1.0 if front_is_outside == (self.fluid == "outside") else -1.0

    def _normal(self, patch: SurfacePatch, uv: Tensor, away: Tensor, slope: Tensor) -> Tensor:
        """Unit normals (N, 3) on the front, such that away.normal is the signed distance."""
        _, su, sv = patch.derivatives(uv)
        front = torch.linalg.cross(su, sv)
        area, distance = front.norm(dim=1), away.norm(dim=1)
        smooth = area > 1e-7 * patch.size**2
        front = front / torch.where(smooth, area, 1.0)[:, None]
        length = patch.size
        along = (away * front).sum(1)
        edge = ~smooth | ((along.abs() < 0.99 * distance) & (distance > 1e-10 * length))
        if bool(edge.any()):
            front[edge] = self._between(patch, uv[edge])
            along = (away * front).sum(1)
        self._report(slope, distance, length, edge)
        askew = edge | (along.abs() < (1.0 - 1e-9) * distance)
        far = distance > torch.where(askew, 1e-10, 1e-6) * length
        sign = torch.where(along < 0, -1.0, 1.0)
        straight = (sign / torch.where(far, distance, 1.0))[:, None] * away
        return torch.where(far[:, None], straight, front)

    @staticmethod
    def _between(patch: SurfacePatch, uv: Tensor) -> Tensor:
        """Mean normal (N, 3) of the surface around an edge, pole or end."""
        total = torch.zeros(len(uv), 3, dtype=torch.float64)
        pole = patch.derivatives(uv)[1].norm(dim=1)
        for du in (-1.0, 1.0):
            for dv in (-1.0, 1.0):
                beside = uv + _ASIDE * torch.tensor([du, dv], dtype=torch.float64)
                beside = torch.maximum(torch.minimum(beside, patch.high), patch.low)
                total += _unit_normal(patch, beside)
        tip = pole <= 1e-9 * patch.size
        if bool(tip.any()) and patch.bases[0].periodic:
            where, around = torch.nonzero(tip)[:, 0], torch.arange(16, dtype=torch.float64) / 16
            inwards = torch.where(uv[where, 1] < 0.5, _ASIDE, -_ASIDE)
            ring = torch.stack(
                [around.repeat(len(where)), (uv[where, 1] + inwards).repeat_interleave(16)], 1
            )
            total[where] = _unit_normal(patch, ring).reshape(-1, 16, 3).sum(1)
        return total / total.norm(dim=1, keepdim=True).clamp(min=1e-300)

    @staticmethod
    def _report(slope: Tensor, distance: Tensor, length: float, edge: Tensor) -> None:
        stuck = (slope > _NOT_STATIONARY) & (distance > 1e-8 * length) & ~edge
        if bool(stuck.any()):
            warn(
                f"{int(stuck.sum())} closest points are only near a minimum (worst slope "
                f"{float(slope[stuck].max()):.1e}); raise samples",
                ConvergenceWarning,
                stacklevel=4,
            )


class BSplineSurface(NurbsSurface):
    """``NurbsSurface`` without weights."""

    def __init__(self, control_points: Tensor, **options):  # type: ignore[no-untyped-def]
        if options.get("weights") is not None:
            raise ValueError("a B-spline has no weights; use NurbsSurface")
        super().__init__(control_points, **options)


def _unit_normal(patch: SurfacePatch, uv: Tensor) -> Tensor:
    _, su, sv = patch.derivatives(uv)
    front = torch.linalg.cross(su, sv)
    return front / front.norm(dim=1, keepdim=True).clamp(min=1e-300)
