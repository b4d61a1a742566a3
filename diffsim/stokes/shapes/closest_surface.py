"""Closest points on a tensor-product spline surface, found by a kernel from samples of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from diffsim.stokes import _ops_surface
from diffsim.stokes.shapes.spline_basis import SplineBasis


@dataclass(frozen=True)
class SurfacePatch:
    """A surface without gradient."""

    homogeneous: Tensor  # (nu, nv, 4), w x, w y, w z, w
    bases: tuple[SplineBasis, SplineBasis]  # spline bases of u and v
    # low, high: range of (u, v), (2,); infinite where periodic
    low: Tensor
    high: Tensor
    size: float  # length scale [m]

    def derivatives(self, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """S, S_u, S_v; (N, 3) each, uv (N, 2)."""
        s, su, sv = _ops_surface.surface_frames(uv=uv, **self._arrays()).unbind(1)
        return s, su, sv

    def closest(
        self, samples: SurfaceSamples, p: Tensor, band: float | None
    ) -> tuple[Tensor, Tensor]:
        """Parameters (N, 2) of the points closest to p (N, 3), on as many threads as PyTorch.

        Farther than ``band`` [m] (if not None) the nearest sample stands for it.

        Returns:
            Parameters and how far each is from stationary, (N,): the cosine between S - p and the
            surface there, 0 where held at the end of the range or not refined.
        """
        uv, slope = _ops_surface.closest_on_surface(
            points=p,
            **self._arrays(),
            sample_uv=samples.uv,
            sample_points=samples.points,
            gap=samples.gap,
            band=math.inf if band is None else band,
            num_threads=torch.get_num_threads(),
        )
        return uv, slope

    def _arrays(self) -> dict[str, Any]:
        """The surface as the ops take it."""
        found: dict[str, Any] = {"homogeneous": self.homogeneous}
        for axis, basis in zip("uv", self.bases, strict=True):
            found[f"breaks_{axis}"] = basis.breaks
            found[f"coefficients_{axis}"] = basis.coefficients
            found[f"first_{axis}"] = basis.active[:, 0]
            found[f"kinks_{axis}"] = torch.tensor(basis.kinks, dtype=torch.float64)
        return found | {"low": self.low.tolist(), "high": self.high.tolist()}


class SurfaceSamples:
    """Points of a surface on a grid of parameters, from which searches start.

    Attributes:
        uv: Parameters, (num_u, num_v, 2).
        points: Points there, (num_u, num_v, 3) [m].
        gap: Greatest distance of two neighbors [m].
    """

    def __init__(self, patch: SurfacePatch, per_span: tuple[int, int], reach: float):
        u, v = (b.samples(n, reach) for b, n in zip(patch.bases, per_span, strict=True))
        u = u[(u >= patch.low[0]) & (u <= patch.high[0])]
        v = v[(v >= patch.low[1]) & (v <= patch.high[1])]
        rows = patch.derivatives(torch.cartesian_prod(u, v))[0].reshape(len(u), len(v), 3)
        spread = (rows - rows[:1]).norm(dim=2).amax(0)
        some = spread > 1e-9 * float(spread.max())  # at a pole any u would do: start beside it
        self.uv = torch.stack(torch.meshgrid(u, v[some], indexing="ij"), 2)
        self.points = rows[:, some]
        gaps = [self.points.diff(dim=k).norm(dim=2).max() for k in (0, 1)]
        self.gap = float(torch.stack(gaps).max())
