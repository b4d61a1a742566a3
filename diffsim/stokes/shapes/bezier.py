"""Walls in the plane: signed distance to Bezier curves, phi > 0 in the fluid, < 0 in the solid.

Polynomials are in Bernstein form on [0, 1]: coefficients on the last axis unless said otherwise.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.core.check import require, require_choice, require_constants, require_range
from diffsim.core.checked import checked
from diffsim.core.numbers import require_unmapped
from diffsim.core.record import warn
from diffsim.core.torch_names import on_constants
from diffsim.stokes import _ops_curve
from diffsim.stokes.shapes.base import Shape, require_weights
from diffsim.stokes.shapes.envelope import signed_distance

_MOST_RATIO = 1e4  # of weights: at 1e6 nearest points were missed by 1e-7 of the size
_DRAWN = 32  # chords per curve where the chain is drawn


class BezierCurve2d(Shape):
    """Signed distance to a Bezier curve or a chain of them, of any degree, rational if weighted.

    phi > 0 on the fluid's side. An open curve goes on along its end tangents without end, so that
    it parts the whole plane; only where these rays meet the curve again is the side not defined.
    The distance is global: all local minima are compared. At corners and cusps the side is the one
    that the curve's two directions agree on. Where several points are equally near (medial axis),
    gradients are those of the one with the smallest parameter. On the curve, gradients are those
    of its normal. thesis 4.2.5, "Signed-distance functions for parametric shapes".

    Args:
        control_points: Control points, (k, 2) float64 [m].
        fluid: Side of the fluid: "left" or "right", seen in the direction of travel; for closed
            curves also "inside" or "outside".
        weights: Weights of a rational curve's control points, (k,) > 0, the largest at most 1e4
            times the smallest.
        degree: Degree of the curves of a chain, neighbors sharing one control point: k = degree x
            num_curves + 1 (open) or degree x num_curves (closed: the last curve ends at the first
            point). None: a single curve.
        closed: Whether the chain returns to its first control point (which is not repeated).
        ends: "tangent" as above, or "stop": an open curve ends, phi is the distance to it, with the
            sign of the end tangent's side (it jumps across the tangent behind the end).

    Raises:
        ValueError: wrong counts, NaN, all control points at one place, a loop without area.
    """

    dim = 2

    def __init__(
        self,
        control_points: Tensor,
        *,
        fluid: str = "left",
        weights: Tensor | None = None,
        degree: int | None = None,
        closed: bool = False,
        ends: str = "tangent",
    ):
        super().__init__()
        self.control_points = require("control_points", control_points, ("k", 2))
        num = len(control_points)
        self.degree = (num if closed else num - 1) if degree is None else int(degree)
        self.closed = bool(closed)
        if self.degree < 1 or num < 2 or (num - (0 if closed else 1)) % self.degree != 0:
            need = "degree x n" if closed else "degree x n + 1"
            raise ValueError(
                f"control_points must be {need} (n >= 1) for degree {self.degree}, got {num}"
            )
        self.weights = None
        if weights is not None:
            self.weights = require_weights(weights, (num,), _MOST_RATIO)
        sides = ("left", "right", "inside", "outside") if closed else ("left", "right")
        self.fluid = require_choice("fluid", fluid, sides)
        self.ends = require_choice("ends", ends, ("tangent", "stop"))
        num_curves = (num - (0 if closed else 1)) // self.degree
        start = self.degree * torch.arange(num_curves)[:, None]
        self._index = (start + torch.arange(self.degree + 1)) % num  # (num_curves, degree + 1)
        require_unmapped(**self._shape())
        require_range("control_points", control_points, at_least=-1e100, at_most=1e100)
        drawn = self.polyline().detach()
        self._side(self._chain())
        place = crossing(drawn)
        if place is not None:
            warn(
                f"the curve crosses itself near ({place[0]:.4g}, {place[1]:.4g}) m; the fluid's "
                "side is that of the nearest branch",
                stacklevel=2,
            )

    @checked(tau=("N",))
    def point(self, tau: Tensor) -> Tensor:
        """Points (N, 2) of the curve; tau (N,) in [0, num_curves]. Gradients: shape."""
        curve, t = self._chain().split(tau)
        return self._on_curve(curve, t)

    @checked
    def polyline(self, chords: int = _DRAWN) -> Tensor:
        """Points along the curve for pictures, (num_curves x chords + 1, 2)."""
        num = len(self._index) * chords
        tau = torch.arange(num + 1, dtype=torch.float64) / chords
        curve = (tau.long()).clamp(max=len(self._index) - 1)
        return self._on_curve(curve, tau - curve)

    @checked
    def closest(self, points: Tensor) -> Tensor:
        """Parameters tau (N,) of the closest points; beyond the ends -s and num_curves + s [m]."""
        hint = "the distance has a gradient, its foot has none; or call it under torch.no_grad()"
        require_constants(
            hint, points=points, control_points=self.control_points, weights=self.weights
        )
        require_unmapped(points=points)
        rays = self._rays()
        rays = None if rays is None else rays.detach()
        return self._chain().closest(require("points", points, ("N", 2)).detach(), rays)[0]

    def _shape(self) -> dict[str, Tensor]:
        weights = {} if self.weights is None else {"weights": self.weights}
        return {"control_points": self.control_points, **weights}

    def level(self, points: Tensor) -> Tensor:
        require_unmapped(points=points, **self._shape())
        chain, rays = self._chain(), self._rays()
        tau, normal = chain.closest(points.detach(), None if rays is None else rays.detach())
        foot = self._on_curve(*chain.split(tau))
        if rays is not None:
            beyond = torch.stack([-tau, tau - chain.num_curves], 1).clamp(min=0.0)
            foot = foot + beyond @ rays
        return signed_distance(points, foot, self._side(chain) * normal)

    def _on_curve(self, curve: Tensor, t: Tensor) -> Tensor:
        """Points with gradient to control points and weights."""
        b = basis(t, self.degree)
        index = self._index[curve]
        if self.weights is not None:
            b = b * self.weights[index]
            b = b / b.sum(1, keepdim=True)
        if len(self._index) == 1:
            return b @ self.control_points[self._index[0]]
        return (b[:, :, None] * self.control_points[index]).sum(1)

    def _end_direction(self, at_end: bool) -> Tensor:
        """Unit vector (2,) out of an open curve's end: away from the next distinct point."""
        points = self.control_points if at_end else self.control_points.flip(0)
        away = points[-1] - points[:-1]
        distinct = torch.nonzero(away.detach().norm(dim=1) > 1e-12 * self._size())[-1, 0]
        return away[distinct] / away[distinct].norm()

    def _rays(self) -> Tensor | None:
        """Directions (2, 2) in which the curve goes on beyond its start and its end, if it does."""
        if self.closed or self.ends == "stop":
            return None
        return torch.stack([self._end_direction(False), self._end_direction(True)])

    def _size(self) -> float:
        p = self.control_points.detach()
        return float((p.amax(0) - p.amin(0)).max())

    def _chain(self) -> Chain:
        p = require("control_points", self.control_points.detach(), ("k", 2))
        size = self._size()
        if not size > 1e-12 * float(p.abs().max()):
            raise ValueError(f"control_points must not all be at one place, {p[0].tolist()}")
        w = torch.ones(len(p), dtype=torch.float64) if self.weights is None else self.weights
        w = require_weights(w.detach(), (len(p),), _MOST_RATIO)[:, None]
        return Chain(torch.cat([w * p, w], 1)[self._index], self.closed, size)

    def _side(self, chain: Chain) -> float:
        """1 where the fluid is on the left."""
        if self.fluid in ("left", "right"):
            return 1.0 if self.fluid == "left" else -1.0
        x = chain.point(torch.arange(chain.num_curves * _DRAWN, dtype=torch.float64) / _DRAWN)
        x = x - x.mean(0)
        following = x.roll(-1, 0)
        area = 0.5 * float((x[:, 0] * following[:, 1] - x[:, 1] * following[:, 0]).sum())
        if abs(area) < 1e-12 * chain.size**2:
            raise ValueError("the loop encloses no area: inside and outside are not defined")
        return 1.0 if (area > 0) == (self.fluid == "inside") else -1.0


@functools.cache
@on_constants()
def binomials(degree: int) -> Tensor:
    """C(n, 0), ..., C(n, n); shared, not to be written to."""
    return torch.tensor([math.comb(degree, k) for k in range(degree + 1)], dtype=torch.float64)


def basis(t: Tensor, degree: int) -> Tensor:
    """C(n, k) t^k (1 - t)^(n - k), (..., n + 1)."""
    s = 1.0 - t
    rising, falling = [torch.ones_like(t)], [torch.ones_like(t)]
    for _ in range(degree):
        rising.append(rising[-1] * t)
        falling.append(falling[-1] * s)
    products = [up * down for up, down in zip(rising, reversed(falling), strict=True)]
    return binomials(degree) * torch.stack(products, -1)


@dataclass(frozen=True)
class Chain:
    """Rational Bezier curves end to end, without gradient; the parameter is curve + t in [0, 1]."""

    homogeneous: Tensor  # (num_curves, degree + 1, 3), columns w x, w y, w
    closed: bool  # whether the last one ends where the first one starts
    size: float  # length scale [m]

    @property
    def num_curves(self) -> int:
        return len(self.homogeneous)

    def split(self, tau: Tensor) -> tuple[Tensor, Tensor]:
        """Curve (N,) int64 and t (N,) in [0, 1]; ends clamped, or wrapped if closed."""
        if self.closed:
            tau = torch.remainder(tau, self.num_curves)
        curve = tau.floor().long().clamp(0, self.num_curves - 1)
        return curve, (tau - curve).clamp(0.0, 1.0)

    def point(self, tau: Tensor) -> Tensor:
        """Points (N, 2) within the ends."""
        curve, t = self.split(tau)
        h = (basis(t, self.homogeneous.shape[1] - 1)[:, :, None] * self.homogeneous[curve]).sum(1)
        return h[:, :2] / h[:, 2:]

    def closest(self, p: Tensor, rays: Tensor | None) -> tuple[Tensor, Tensor]:
        """Points closest to p (N, 2), without gradient.

        Args:
            rays: Unit directions in which the chain goes on straight before its start and after
                its end, (2, 2); None if it does not.

        Returns:
            Parameters (N,), the smallest one of those equally near (to 1e-13 of the chain's size),
            on the rays -s and num_curves + s, s [m]; unit normals (N, 2) on the left side, such
            that normal.(p - closest point) is the signed distance.
        """
        return _ops_curve.closest_on_curves(
            points=p,
            homogeneous=self.homogeneous,
            rays=p.new_zeros(0) if rays is None else rays,
            closed=self.closed,
            size=self.size,
        )


def crossing(polyline: Tensor) -> tuple[float, float] | None:
    """A point where two chords that are not neighbors cross, or None.

    Args:
        polyline: (N + 1, 2) [m]; first and last point may coincide (then their chords are
            neighbors).
    """
    a, b = polyline[:-1], polyline[1:]
    d = b - a
    start = _cross(d[:, None], a[None] - a[:, None])  # which side of chord i chord j starts on
    end = _cross(d[:, None], b[None] - a[:, None])
    parts = start * end < 0
    hit = parts & parts.T
    num = len(a)
    i = torch.arange(num)
    apart = (i[:, None] - i[None]).abs()
    hit &= apart > 1
    if bool((polyline[0] == polyline[-1]).all()):
        hit &= apart < num - 1
    crossings = torch.nonzero(hit)
    if len(crossings) == 0:
        return None
    first, second = crossings[0].tolist()
    s = start[first, second] / (start[first, second] - end[first, second])
    x, y = (a[second] + s * d[second]).tolist()
    return x, y


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
