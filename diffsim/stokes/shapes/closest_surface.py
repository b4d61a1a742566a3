"""Closest points on a tensor-product spline surface: nearest samples, then Newton from each sheet.

f(u, v) = |S(u, v) - p|^2 / 2; Newton with the absolute eigenvalues of its Hessian, steps shortened
until f falls, parameters held in their range and, at first, within a piece without kinks.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from diffsim.stokes.shapes.spline_basis import SplineBasis

_MAX_ITERS = 60
_NEIGHBORS = (8, 24)  # samples looked at for other sheets that are as near: close by, farther away
_CLOSE_BY = 4.0  # sample spacings
_MAX_SHEETS = 3
_LEAST = 1e-5  # eigenvalue taken for the Hessian where it is singular (centers of curvature)
_BESIDE = 1e-12  # parameter distance at which feet on a kink are held, on either side of it
_MAX_PIECES = 6  # entered one after the other, over their kinks
_CHUNK = 16384  # points at a time, so that temporaries stay in the cache


@dataclass(frozen=True)
class SurfacePatch:
    """A surface without gradient.

    Attributes:
        homogeneous: (nu, nv, 4), w x, w y, w z, w.
        bases: Spline bases of u and v.
        low, high: Range of (u, v), (2,); infinite where periodic.
        size: Length scale [m].
    """

    homogeneous: Tensor
    bases: tuple[SplineBasis, SplineBasis]
    low: Tensor
    high: Tensor
    size: float

    def piece(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        """Range (N, 2) each, low and high, of the piece without kinks in which uv (N, 2) lie."""
        low, high = self.low.expand_as(uv).clone(), self.high.expand_as(uv).clone()
        for k, basis in enumerate(self.bases):
            if not basis.kinks:
                continue
            kinks = torch.tensor(basis.kinks, dtype=torch.float64)
            if basis.periodic:
                turns = uv[:, k].floor()
                kinks = torch.cat([kinks[-1:] - 1.0, kinks, kinks[:1] + 1.0])
            else:
                turns = torch.zeros(len(uv), dtype=torch.float64)
            after = torch.searchsorted(kinks, (uv[:, k] - turns).contiguous(), right=True)
            least = torch.cat([self.low[k : k + 1], kinks + _BESIDE])[after] + turns
            most = torch.cat([kinks - _BESIDE, self.high[k : k + 1]])[after] + turns
            low[:, k], high[:, k] = least, most
        return low, high

    def derivatives(self, uv: Tensor, order: int) -> list[Tensor]:
        """S, S_u, S_v and for order 2 S_uu, S_uv, S_vv; (N, 3) each, uv (N, 2)."""
        bu, bv = self.bases[0](uv[:, 0], order), self.bases[1](uv[:, 1], order)
        nu, nv, _ = self.homogeneous.shape
        rows = bu @ self.homogeneous.reshape(nu, nv * 4)
        rows = rows.reshape(order + 1, -1, nv, 4)

        def h(i: int, j: int) -> Tensor:
            return (bv[j][:, None] @ rows[i])[:, 0]

        a = h(0, 0)
        w = a[:, 3:]
        s = a[:, :3] / w
        hu, hv = h(1, 0), h(0, 1)
        su, sv = (hu[:, :3] - hu[:, 3:] * s) / w, (hv[:, :3] - hv[:, 3:] * s) / w
        if order == 1:
            return [s, su, sv]
        huu, huv, hvv = h(2, 0), h(1, 1), h(0, 2)
        suu = (huu[:, :3] - 2.0 * hu[:, 3:] * su - huu[:, 3:] * s) / w
        svv = (hvv[:, :3] - 2.0 * hv[:, 3:] * sv - hvv[:, 3:] * s) / w
        suv = (huv[:, :3] - hu[:, 3:] * sv - hv[:, 3:] * su - huv[:, 3:] * s) / w
        return [s, su, sv, suu, suv, svv]


class SurfaceSamples:
    """Points of a surface on a grid of parameters, in a search tree."""

    def __init__(self, patch: SurfacePatch, per_span: tuple[int, int], reach: float):
        u, v = (b.samples(n, reach) for b, n in zip(patch.bases, per_span, strict=True))
        u = u[(u >= patch.low[0]) & (u <= patch.high[0])]
        v = v[(v >= patch.low[1]) & (v <= patch.high[1])]
        rows = patch.derivatives(torch.cartesian_prod(u, v), 1)[0].reshape(len(u), len(v), 3)
        spread = (rows - rows[:1]).norm(dim=2).amax(0)
        v = v[spread > 1e-9 * float(spread.max())]  # at a pole any u would do: start beside it
        self.shape = (len(u), len(v))
        self.periodic = [b.periodic for b in patch.bases]
        self.uv = torch.cartesian_prod(u, v).reshape(-1, 2)
        self.points = patch.derivatives(self.uv, 1)[0]
        grid = self.points.reshape(*self.shape, 3)
        gaps = [(grid.diff(dim=k)).norm(dim=2).max() for k in (0, 1)]
        self.gap = float(torch.stack(gaps).max())
        self.spacing = torch.tensor([1.0 / self.shape[0], 1.0 / self.shape[1]]).to(torch.float64)
        self._tree = cKDTree(self.points.numpy())

    def nearest(self, p: Tensor, num: int) -> tuple[Tensor, Tensor]:
        """Distances and indices of the nearest samples, (N, num) each, in order."""
        distance, index = self._tree.query(p.numpy(), k=num)
        shape = (len(p), num)
        return torch.as_tensor(distance).reshape(shape), torch.as_tensor(index).reshape(shape)

    def other_sheet(self, index: Tensor, seen: list[Tensor]) -> tuple[Tensor, Tensor]:
        """First of the samples (N, num) not beside those seen (N,): whether there is one, which."""
        apart = torch.ones(index.shape, dtype=torch.bool)
        for other in seen:
            beside = torch.ones_like(apart)
            for k, split in enumerate((lambda i: i // self.shape[1], lambda i: i % self.shape[1])):
                away = (split(index) - split(other)[:, None]).abs()
                if self.periodic[k]:
                    away = torch.minimum(away, self.shape[k] - away)
                beside &= away <= 3
            apart &= ~beside
        column = apart.int().argmax(1, keepdim=True)
        return apart.any(1), index.gather(1, column)[:, 0]


def closest(
    patch: SurfacePatch, samples: SurfaceSamples, p: Tensor, band: float | None
) -> tuple[Tensor, Tensor]:
    """Parameters (N, 2) of the points closest to p (N, 3).

    Farther than ``band`` [m] (if not None) the nearest sample stands for it.

    Returns:
        Parameters and how far each is from stationary, (N,): the cosine between S - p and the
        surface there, 0 where held at the end of the range or not refined.
    """
    distance, index = samples.nearest(p, 1)
    uv, slope = samples.uv[index[:, 0]].clone(), torch.zeros(len(p), dtype=torch.float64)
    d = distance[:, 0]
    close_by = d <= _CLOSE_BY * samples.gap
    wanted = torch.ones_like(close_by) if band is None else d <= band + samples.gap
    for group, num in zip((wanted & close_by, wanted & ~close_by), _NEIGHBORS, strict=True):
        for some in torch.nonzero(group)[:, 0].split(_CHUNK):
            uv[some], slope[some] = _refine_samples(patch, samples, p[some], num)
    return uv, slope


def _refine_samples(
    patch: SurfacePatch, samples: SurfaceSamples, p: Tensor, num: int
) -> tuple[Tensor, Tensor]:
    _, index = samples.nearest(p, min(num, len(samples.points)))
    uv, f, slope = _descend_over(patch, samples, samples.uv[index[:, 0]], p)
    seen = [index[:, 0]]
    for _ in range(_MAX_SHEETS - 1):
        exists, sample = samples.other_sheet(index, seen)
        seen.append(sample)
        other = torch.nonzero(exists)[:, 0]
        if len(other) == 0:
            break
        uv2, f2, slope2 = _descend_over(patch, samples, samples.uv[sample[other]], p[other])
        better = f2 < f[other]
        which = other[better]
        uv[which], f[which], slope[which] = uv2[better], f2[better], slope2[better]
    return uv, slope


def _descend_over(
    patch: SurfacePatch, samples: SurfaceSamples, uv: Tensor, p: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`_descend` that goes on beyond a kink at which it was held."""
    if not any(basis.kinks for basis in patch.bases):
        return _descend(patch, samples, uv, p)
    low, high = patch.piece(uv)
    start = torch.maximum(torch.minimum(uv, high), low)
    uv, f, slope = _descend(patch, samples, start, p)
    todo = torch.arange(len(p))
    for _ in range(_MAX_PIECES):
        moved = torch.zeros(len(p), dtype=torch.bool)
        for k, basis in enumerate(patch.bases):
            if not basis.kinks:
                continue
            here = uv[todo]
            low, high = patch.piece(here)
            side = (here >= high)[:, k].to(here) - (here <= low)[:, k].to(here)
            over = here.clone()
            over[:, k] += 2.5 * _BESIDE * side
            inner = (over[:, k] > patch.low[k]) & (over[:, k] < patch.high[k]) & (side != 0)
            who = todo[inner]
            uv2, f2, slope2 = _descend(patch, samples, over[inner], p[who])
            better = f2 < f[who] * (1.0 - 1e-11)
            which = who[better]
            uv[which], f[which], slope[which] = uv2[better], f2[better], slope2[better]
            moved[which] = True
        todo = torch.nonzero(moved)[:, 0]
        if len(todo) == 0:
            break
    return uv, f, slope


def _descend(
    patch: SurfacePatch, samples: SurfaceSamples, uv: Tensor, p: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Local minimum of f from each start (N, 2): parameters, f and slope as in :func:`closest`."""
    uv, f_out = uv.clone(), torch.zeros(len(p), dtype=torch.float64)
    slope_out = torch.zeros(len(p), dtype=torch.float64)
    todo, x, q = torch.arange(len(p)), uv.clone(), p
    low, high = patch.piece(uv)
    s, su, sv, suu, suv, svv = patch.derivatives(x, 2)
    for iteration in range(_MAX_ITERS):
        e = s - q
        f = 0.5 * _dot(e, e)
        gradient = torch.stack([_dot(e, su), _dot(e, sv)], 1)
        gauss = torch.stack([_dot(su, su), _dot(su, sv), _dot(sv, sv)], 1)
        bend = torch.stack([_dot(e, suu), _dot(e, suv), _dot(e, svv)], 1)
        held = ((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0))
        step = _newton_step(gradient, gauss, bend, held)
        most = (step.abs() / (4.0 * samples.spacing)).amax(1, keepdim=True).clamp(min=1.0)
        step = step / most
        steep = (gradient.abs() * ~held) / gauss[:, ::2].sqrt().clamp(min=1e-300)
        slope = steep.amax(1) / (2.0 * f).sqrt().clamp(min=1e-300)
        trial = torch.maximum(torch.minimum(x + step, high), low)
        values = patch.derivatives(trial, 2)
        f_new = 0.5 * ((values[0] - q) ** 2).sum(1)
        falls = -_dot(gradient, step)  # to first order
        shrink = torch.ones_like(f)
        for _ in range(12):  # shorten the steps that climb by more than rounding
            bad = torch.nonzero((f_new > f) & (falls > 1e-12 * f))[:, 0]
            if len(bad) == 0:
                break
            shrink[bad] *= 0.25
            part = x[bad] + shrink[bad, None] * step[bad]
            trial[bad] = torch.maximum(torch.minimum(part, high[bad]), low[bad])
            redone = patch.derivatives(trial[bad], 2)
            for old, new in zip(values, redone, strict=True):
                old[bad] = new
            f_new[bad] = 0.5 * ((redone[0] - q[bad]) ** 2).sum(1)
        worse = f_new > f
        trial[worse] = x[worse]
        moved = ((trial - x).abs()).amax(1)
        done = worse | (moved <= 1e-13) | (falls <= 1e-22 * f)
        last = torch.ones_like(done) if iteration == _MAX_ITERS - 1 else done
        out = todo[last]
        uv[out], f_out[out], slope_out[out] = (
            trial[last],
            torch.minimum(f, f_new)[last],
            slope[last],
        )
        keep = ~last
        if not bool(keep.any()):
            break
        todo, x, q = todo[keep], trial[keep], q[keep]
        low, high = low[keep], high[keep]
        s, su, sv, suu, suv, svv = (d[keep] for d in values)
    return uv, f_out, slope_out


def _newton_step(gradient: Tensor, gauss: Tensor, bend: Tensor, held: Tensor) -> Tensor:
    """-|H|^-1 g, the eigenvalues of H taken positive in the metric of the surface; held ones 0.

    Matrices are given as (N, 3): uu, uv, vv. In coordinates in which the first fundamental form is
    the identity, H = gauss + bend becomes a, b, c; its eigenvalues are m +- r.
    """
    free = (~held).to(gradient)
    g = gradient * free
    both = free[:, 0] * free[:, 1]
    l11 = (gauss[:, 0] + 1e-300).sqrt()
    l21 = both * gauss[:, 1] / l11
    l22 = (gauss[:, 2] - l21**2).clamp(min=1e-14 * gauss[:, 2] + 1e-300).sqrt()
    h = gauss + bend
    a = h[:, 0] / l11**2
    b = (both * h[:, 1] - l21 / l11 * h[:, 0]) / (l11 * l22) * both
    c = (h[:, 2] - 2.0 * both * l21 / l11 * h[:, 1] + (l21 / l11) ** 2 * h[:, 0]) / l22**2
    ga = g[:, 0] / l11
    gb = (g[:, 1] - l21 * ga) / l22
    m, r = 0.5 * (a + c), torch.hypot(0.5 * (a - c), b)
    high, low = (m + r).abs().clamp(min=_LEAST), (m - r).abs().clamp(min=_LEAST)
    # |H|^-1 = (p + q (H - m) / r), p and q from the inverses of the two eigenvalues
    p, q = 0.5 * (1.0 / high + 1.0 / low), 0.5 * (1.0 / high - 1.0 / low) / r.clamp(min=1e-300)
    ya = -(p * ga + q * (0.5 * (a - c) * ga + b * gb))
    yb = -(p * gb + q * (b * ga - 0.5 * (a - c) * gb))
    v = yb / l22
    return torch.stack([(ya - l21 * v) / l11, v], 1) * free


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(1)
