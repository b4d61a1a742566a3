"""Closest points on a chain of rational Bezier curves in the plane: all minima, no start values.

With W the weighted control polynomial, w the weights', x = W / w: the distance from p is stationary
where g(t) = (W - p w).(W' w - W w') = 0. g is linear in p, so its Bernstein coefficients on a piece
are A - p D with A and D computed once.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.stokes.shapes.bernstein import basis, derivative, product, restriction, rising_roots

_PARTS = 8  # each curve is cut so that most parts are discarded by their bounding discs
_CHUNK = 32768  # points at a time


@dataclass(frozen=True)
class Chain:
    """Rational Bezier curves end to end, without gradient; the parameter is curve + t in [0, 1].

    Attributes:
        homogeneous: (num_curves, degree + 1, 3), columns w x, w y, w.
        closed: Whether the last one ends where the first one starts.
        size: Length scale [m].
    """

    homogeneous: Tensor
    closed: bool
    size: float

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

    def tangent(self, tau: Tensor) -> Tensor:
        """dx/dt (N, 2); at a joint that of the curve which starts there."""
        curve, t = self.split(tau)
        local = self.homogeneous[curve]
        degree = local.shape[1] - 1
        h = (basis(t, degree)[:, :, None] * local).sum(1)
        slope = degree * (local[:, 1:] - local[:, :-1])
        dh = (basis(t, degree - 1)[:, :, None] * slope).sum(1)
        return (dh[:, :2] - h[:, :2] / h[:, 2:] * dh[:, 2:]) / h[:, 2:]


def closest(chain: Chain, p: Tensor, rays: Tensor | None) -> Tensor:
    """Parameters (N,) of the points closest to p (N, 2).

    Args:
        chain: Curves that follow one another.
        p: Points.
        rays: Unit directions in which the chain goes on straight before its start and after its
            end, (2, 2); None if it does not. Parameters on them are -s and num_curves + s, s [m].

    Returns:
        Parameter; the smallest one of those equally near (to 1e-13 of the chain's size).
    """
    if len(p) == 0:
        return p.new_zeros(0)
    parts = _Parts(chain)
    return torch.cat([_closest(chain, parts, q, rays) for q in p.split(_CHUNK)])


class _Parts:
    """The chain cut into parts: coefficients of g and bounding discs."""

    def __init__(self, chain: Chain):
        h = chain.homogeneous
        degree = h.shape[1] - 1
        cuts = [k / _PARTS for k in range(_PARTS + 1)]
        maps = [restriction(degree, a, b) for a, b in itertools.pairwise(cuts)]
        cut = (torch.stack(maps)[None] @ h[:, None]).flatten(0, 1).transpose(1, 2)  # (S, 3, n + 1)
        weighted, w = cut[:, :2], cut[:, 2:]
        along = product(derivative(weighted), w) - product(weighted, derivative(w))
        self.a = product(weighted, along).sum(1)
        self.d = product(w, along)
        corners = weighted / w
        low, high = corners.amin(2), corners.amax(2)
        self.center = 0.5 * (low + high)
        self.radius = (corners - self.center[:, :, None]).norm(dim=1).amax(1)
        num = len(h) * _PARTS
        self.start = torch.arange(num, dtype=torch.float64) / _PARTS
        self.ends = torch.arange(num if chain.closed else num + 1, dtype=torch.float64) / _PARTS
        self.end_points = chain.point(self.ends)


def _distances(p: Tensor, q: Tensor) -> Tensor:
    return torch.cdist(p, q, compute_mode="donot_use_mm_for_euclid_dist")  # no cancellation


def _closest(chain: Chain, parts: _Parts, p: Tensor, rays: Tensor | None) -> Tensor:
    near, which = _distances(p, parts.end_points).min(1)
    point, tau, distance = [torch.arange(len(p))], [parts.ends[which]], [near]
    for end in range(0 if rays is None else 2):
        tip = parts.end_points[-end]
        s = (p - tip) @ rays[end]  # type: ignore[index]
        on = s > 0
        off = p[on] - tip - s[on, None] * rays[end]  # type: ignore[index]
        point.append(torch.nonzero(on)[:, 0])
        tau.append(-s[on] if end == 0 else chain.num_curves + s[on])
        distance.append(off.norm(dim=1))
    bound = _distances(p, parts.center) - parts.radius
    i, part = torch.nonzero(bound <= near[:, None] + 1e-12 * chain.size, as_tuple=True)
    g = parts.a[part] - (p[i, :, None] * parts.d[part]).sum(1)
    row, t = rising_roots(g)
    point.append(i[row])
    tau.append(parts.start[part[row]] + t / _PARTS)
    distance.append((p[point[-1]] - chain.point(tau[-1])).norm(dim=1))
    who, param, d = torch.cat(point), torch.cat(tau), torch.cat(distance)
    least = torch.full((len(p),), torch.inf, dtype=torch.float64)
    least.scatter_reduce_(0, who, d, "amin")
    tied = d <= least[who] + 1e-13 * chain.size
    first = torch.full((len(p),), torch.inf, dtype=torch.float64)
    return first.scatter_reduce_(0, who[tied], param[tied], "amin")
