"""Closest points on a chain of rational Bezier curves in the plane."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffsim.stokes import _ops_curve
from diffsim.stokes.shapes.bernstein import basis


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

    def closest(self, p: Tensor, rays: Tensor | None) -> tuple[Tensor, Tensor]:
        """Points closest to p (N, 2), without gradient.

        Args:
            p: Points.
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
