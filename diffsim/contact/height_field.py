"""Terrain: the solid below a smooth surface z = h(x, y) through given heights."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.contact.handles import shape_of
from diffsim.contact.shapes import Pair, Shape
from diffsim.core.check import require, require_constant, require_range
from diffsim.core.layer import custom_op
from diffsim.core.numbers import require_unmapped
from diffsim.core.values import Vector, dot, scalar, vector

# Catmull-Rom cubics of the four neighbors, by rising powers of t: interpolating, C1
_CUBIC = 0.5 * torch.tensor(
    [[0.0, 2.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [2.0, -5.0, 4.0, -1.0], [-1.0, 3.0, -3.0, 1.0]],
    dtype=torch.float64,
)
_SAMPLES = 5
_MAX_ITERS = 40


class HeightField(Shape):
    """Terrain below a bicubic (Catmull-Rom) surface through heights on a grid.

    The surface interpolates the heights, has a continuous normal and reproduces quadratics; its
    error for smooth terrain falls with the third power of the spacing. Beyond the grid it goes on
    with the slope of its border.

    phi is the distance along the normal through the closest point, found by a safeguarded Newton
    iteration to rounding. The closest point is the global one nearer to the surface than its least
    radius of curvature; farther away it is the best of a search and may be a local one. At a
    center of curvature, where the closest point is not unique, gradients are those of the
    Gauss-Newton step: finite, not meaningful.

    Args:
        heights: Heights of the grid's points, (nx, ny) float64 [m], at least 3 x 3; may carry a
            gradient.
        spacing: Grid spacing along x and y: a number or two [m].
        origin: Place of heights[0, 0] at height 0, (3,) [m].
    """

    def __init__(
        self,
        heights: Tensor,
        spacing: float | tuple[float, float],
        origin: Vector = (0.0, 0.0, 0.0),
        *,
        inside_out: bool = False,
    ):
        super().__init__(inside_out)
        self.heights = require("heights", heights, ("nx", "ny"))
        require_range("heights", self.heights, at_least=-1e100, at_most=1e100, hint="unit is m")
        if min(heights.shape) < 3:
            raise ValueError(f"heights must be at least 3 x 3, got {tuple(heights.shape)}")
        both = spacing if isinstance(spacing, (tuple, list)) else (spacing, spacing)
        if len(both) != 2:
            raise ValueError(f"spacing must be one or two numbers, got {spacing}")
        require_constant("spacing", list(both), "heights carry a gradient")
        self.spacing = torch.stack([scalar("spacing", s, above=0.0) for s in both]).detach()
        self.origin = vector("origin", origin)

    def _solid(self, x: Tensor) -> Pair:
        require_unmapped(x=x, heights=self.heights, origin=self.origin)
        p = x.reshape(-1, 3) - self.origin
        padded = _pad_by_extrapolation(self.heights)
        with torch.no_grad():
            if torch.compiler.is_compiling():
                xy = closest_in_graph(padded.detach(), p.detach(), handle=self.handle)
            else:
                xy = self._closest(padded.detach(), p.detach())
            _, grad, hess = self._surface(padded.detach(), xy, p.detach())
            inverse = _safe_inverse(grad, hess)
        # implicit function theorem: one Newton step with the Jacobian held has the exact gradient
        residual, _, _ = self._surface(padded, xy, p)
        xy = xy - (inverse @ residual[..., None])[..., 0]
        h, slope = self._height(padded, xy)[:2]
        normal = torch.cat([-slope, torch.ones_like(h)[:, None]], dim=1)
        normal = normal / normal.norm(dim=1, keepdim=True)
        phi = dot(p - torch.cat([xy, h[:, None]], dim=1), normal)
        return phi.reshape(x.shape[:-1]), normal.reshape(x.shape)

    def _closest(self, padded: Tensor, p: Tensor) -> Tensor:
        """Minimize |p - (xy, h(xy))|^2 from the best of a few samples around the foot, (N, 2)."""
        drop = (p[:, 2] - self._value(padded, p[:, :2])).abs()
        line = torch.linspace(-1.0, 1.0, _SAMPLES, dtype=torch.float64)
        around = torch.cartesian_prod(line, line)
        trial = p[:, None, :2] + drop[:, None, None] * around
        cost = self._cost(padded, trial, p[:, None])
        best, pick = cost.min(1)
        xy = trial[torch.arange(len(p)), pick]
        rows, cell = torch.arange(len(p)), float(self.spacing.max())  # rows not yet converged
        for _ in range(_MAX_ITERS):
            residual, grad, hess = self._surface(padded, xy[rows], p[rows])
            move = -(_safe_inverse(grad, hess) @ residual[..., None])[..., 0]
            moving = move.abs().amax(1) > 1e-10 * (cell + xy[rows].abs().amax(1))
            rows, move = rows[moving], move[moving]
            if not len(rows):
                break
            rows = rows[self._descend(padded, p, xy, best, rows, move)]
        return xy

    def _descend(
        self, padded: Tensor, p: Tensor, xy: Tensor, best: Tensor, rows: Tensor, move: Tensor
    ) -> Tensor:
        """Take the moves, halved until they go down; (len(rows),) bool: which did."""
        done = torch.zeros(len(rows), dtype=torch.bool)
        for _ in range(8):
            left = torch.nonzero(~done).flatten()
            if not len(left):
                break
            trial = xy[rows[left]] + move[left]
            cost = self._cost(padded, trial, p[rows[left]])
            better = cost <= best[rows[left]]
            took = left[better]
            xy[rows[took]], best[rows[took]] = trial[better], cost[better]
            done[took] = True
            move = 0.5 * move
        return done

    def _cost(self, padded: Tensor, xy: Tensor, p: Tensor) -> Tensor:
        return (xy - p[..., :2]).square().sum(-1) + (self._value(padded, xy) - p[..., 2]).square()

    def _surface(self, padded: Tensor, xy: Tensor, p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Half the gradient of |p - (xy, h)|^2, and grad h, (h - z) hess h."""
        h, slope, hess = self._height(padded, xy)
        drop = (h - p[..., 2])[..., None]
        return xy - p[..., :2] + drop * slope, slope, drop[..., None] * hess

    def _height(self, padded: Tensor, xy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """h (...), its slopes (..., 2) and second derivatives (..., 2, 2)."""
        patch, wu, wv = self._patch(padded, xy)
        along_x = [(patch * w[..., :, None]).sum(-2) for w in wu]
        dx, dy = self.spacing

        def at(a: int, b: int) -> Tensor:
            return dot(along_x[a], wv[b])

        mixed = at(1, 1) / (dx * dy)
        hess = torch.stack([at(2, 0) / dx**2, mixed, mixed, at(0, 2) / dy**2], dim=-1)
        slope = torch.stack([at(1, 0) / dx, at(0, 1) / dy], dim=-1)
        return at(0, 0), slope, hess.reshape(*hess.shape[:-1], 2, 2)

    def _value(self, padded: Tensor, xy: Tensor) -> Tensor:
        """h (...) alone."""
        patch, wu, wv = self._patch(padded, xy)
        return dot((patch * wu[0][..., :, None]).sum(-2), wv[0])

    def _patch(self, padded: Tensor, xy: Tensor) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        """The 4 x 4 heights around each point and their weights, with two derivatives."""
        nx, ny = self.heights.shape
        i, *wu = _weights(xy[..., 0] / self.spacing[0], nx)
        j, *wv = _weights(xy[..., 1] / self.spacing[1], ny)
        first = i * (ny + 2) + j
        four = torch.arange(4)
        near = (four[:, None] * (ny + 2) + four).flatten()
        patch = padded.reshape(-1)[first[..., None] + near].reshape(*first.shape, 4, 4)
        return patch, wu, wv


@custom_op("diffsim::contact_closest_on_terrain")
def closest_in_graph(padded: Tensor, p: Tensor, *, handle: int) -> Tensor:
    """:meth:`HeightField._closest` of the shape with a handle, for graphs."""
    return shape_of(handle, HeightField)._closest(padded, p)


@closest_in_graph.register_fake
def _(padded: Tensor, p: Tensor, *, handle: int) -> Tensor:
    return p.new_empty(len(p), 2)


def _weights(u: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """First neighbor in the padded grid; weights of four and their derivatives, (..., 4)."""
    first = u.detach().floor().clamp(0, count - 2).long()
    t = u - first
    cell = t.clamp(0.0, 1.0)
    one, zero = torch.ones_like(t), torch.zeros_like(t)
    value = torch.stack([one, cell, cell**2, cell**3], -1) @ _CUBIC
    first_derivative = torch.stack([zero, one, 2 * cell, 3 * cell**2], -1) @ _CUBIC
    second = torch.stack([zero, zero, 2 * one, 6 * cell], -1) @ _CUBIC
    beyond = (t - cell)[..., None]  # outside the grid: linear
    within = (beyond.detach() == 0).to(t)
    return first, value + beyond * first_derivative, first_derivative, within * second


def _pad_by_extrapolation(h: Tensor) -> Tensor:
    """One more row and column on every side, by quadratic extrapolation."""
    for _ in range(2):
        low = 3.0 * h[:1] - 3.0 * h[1:2] + h[2:3]
        high = 3.0 * h[-1:] - 3.0 * h[-2:-1] + h[-3:-2]
        h = torch.cat([low, h, high]).T
    return h


def _safe_inverse(slope: Tensor, curvature: Tensor) -> Tensor:
    """Inverse of I + slope slope' + curvature, without curvature where that is not positive."""
    flat = torch.eye(2, dtype=slope.dtype) + slope[..., :, None] * slope[..., None, :]
    full = flat + curvature
    determinant = full[..., 0, 0] * full[..., 1, 1] - full[..., 0, 1] ** 2
    good = (determinant > 1e-6) & (full[..., 0, 0] > 0)
    return torch.linalg.inv(torch.where(good[..., None, None], full, flat))
