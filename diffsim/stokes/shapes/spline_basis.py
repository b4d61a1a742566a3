"""B-spline basis functions of one parameter on [0, 1]: clamped, or periodic with period 1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from diffsim.core.checked import checked
from diffsim.core.numbers import anywhere


class SplineBasis:
    """Basis functions with first and second derivatives, as polynomials per knot span.

    Args:
        num: Number of basis functions (control points), without repetition if periodic.
        degree: Degree of the polynomials, 1 to 5.
        periodic: Whether the parameter wraps.
        knots: Clamped: num + degree + 1 values, not falling, the first and last degree + 1 equal.
            Periodic: num + 1 values, not falling, one period; function i lives on knots i to i +
            degree + 1. Scaled to [0, 1]; uniform if None.
        extend: Clamped only: beyond 0 and 1 go on with the tangent instead of stopping.

    Attributes:
        breaks: Different knots from 0 to 1, (num_spans + 1,).
        coefficients: Of the functions that are not zero on each span, in powers of x, which goes
            from 0 to 1 there; (num_spans, degree + 1, degree + 1).
        active: Which functions these are, (num_spans, degree + 1).
        kinks: Parameters at which the derivative may jump (knots repeated ``degree`` times).
    """

    @checked
    def __init__(
        self,
        num: int,
        degree: int,
        *,
        periodic: bool,
        knots: Sequence[float] | None = None,
        extend: bool = False,
    ):
        least = 3 if periodic else degree + 1
        if not 1 <= degree <= 5:
            raise ValueError(f"degree must lie in [1, 5], got {degree}")
        if num < least:
            kind = "periodic" if periodic else "clamped"
            raise ValueError(
                f"a {kind} B-spline of degree {degree} needs at least {least} control points, "
                f"got {num}"
            )
        self.num, self.degree, self.periodic, self.extend = num, degree, periodic, extend
        full, first = (
            _periodic_knots(num, degree, knots) if periodic else _clamped_knots(num, degree, knots)
        )
        spans = [s for s in range(first, first + (num if periodic else num - degree))]
        spans = [s for s in spans if full[s + 1] > full[s]]
        self.breaks = torch.tensor([full[s] for s in spans] + [full[spans[-1] + 1]])
        self.breaks = self.breaks.to(torch.float64)
        repeated = [k for k in set(full[spans].tolist()) if (full == k).sum() >= degree]
        self.kinks = sorted(k for k in repeated if periodic or 0.0 < k < 1.0)
        self.coefficients = torch.tensor(np.stack([_span(full, s, degree) for s in spans]))
        active = torch.tensor(spans)[:, None] - degree + torch.arange(degree + 1)
        self.active = active % num

    @checked(u=("N",))
    def __call__(self, u: Tensor, order: int = 2) -> Tensor:
        """Values and derivatives up to an order <= 2, (order + 1, N, num), at u (N,)."""
        inside = torch.remainder(u, 1.0) if self.periodic else u.clamp(0.0, 1.0)
        span = torch.searchsorted(self.breaks, inside, right=True) - 1
        span = span.clamp(0, len(self.breaks) - 2)
        h = (self.breaks[1:] - self.breaks[:-1])[span]
        x = (inside - self.breaks[span]) / h
        zero = torch.zeros_like(x)
        powers = [[torch.ones_like(x), *[zero] * order]]  # x^k and its derivatives
        for k in range(1, self.degree + 1):
            lower = powers[-1]
            powers.append([lower[0] * x, *((k / h) * lower[i] for i in range(order))])
        monomials = torch.stack([torch.stack(row, -1) for row in powers], 1)
        local = (self.coefficients[span] @ monomials).permute(2, 0, 1)  # (order + 1, N, active)
        beyond = u - inside
        if self.extend and not self.periodic and anywhere(beyond != 0):
            slope = local[1] if order > 0 else self(inside, 1)[1].gather(1, self.active[span])
            straight = [local[0] + beyond[:, None] * slope, *local[1:]]
            if order == 2:
                straight[2] = torch.where((beyond != 0)[:, None], 0.0, local[2])
            local = torch.stack(straight)
        out = torch.zeros_like(local[..., :1]).repeat(1, 1, self.num)
        return out.scatter_add(2, self.active[span].expand_as(local), local)

    @checked
    def samples(self, per_span: int, reach: float) -> Tensor:
        """Parameters evenly spread over each span, and ``reach`` beyond both ends."""
        t = torch.arange(per_span, dtype=torch.float64) / per_span
        low, high = self.breaks[:-1, None], self.breaks[1:, None]
        u = (low + (high - low) * t).flatten()
        if self.periodic:
            return u
        u = torch.cat([u, self.breaks[-1:]])
        if not self.extend or reach == 0:
            return u
        beyond = reach * torch.arange(1, per_span + 1, dtype=torch.float64) / per_span
        return torch.cat([-beyond.flip(0), u, 1.0 + beyond])


def _clamped_knots(num: int, degree: int, knots: Sequence[float] | None) -> tuple[np.ndarray, int]:
    if knots is None:
        inner = np.linspace(0.0, 1.0, num - degree + 1)
        return np.concatenate([np.zeros(degree), inner, np.ones(degree)]), degree
    full = _check_knots(knots, num + degree + 1)
    if full[degree] != 0.0 or full[-degree - 1] != 1.0:
        raise ValueError(f"the first and last {degree + 1} knots must be equal (clamped)")
    return full, degree


def _periodic_knots(num: int, degree: int, knots: Sequence[float] | None) -> tuple[np.ndarray, int]:
    period = np.linspace(0.0, 1.0, num + 1) if knots is None else _check_knots(knots, num + 1)
    index = np.arange(-degree, num + degree + 1)
    return period[index % num] + index // num, degree


def _check_knots(knots: Sequence[float], num: int) -> np.ndarray:
    full = np.asarray(knots, dtype=np.float64)
    if full.shape != (num,) or not np.isfinite(full).all():
        raise ValueError(f"knots must be {num} finite numbers, got shape {full.shape}")
    if (np.diff(full) < 0).any() or full[-1] <= full[0]:
        raise ValueError("knots must not fall, and the last must exceed the first")
    return (full - full[0]) / (full[-1] - full[0])


def _span(knots: np.ndarray, span: int, degree: int) -> np.ndarray:
    """Coefficients (degree + 1, degree + 1) of the active functions in powers of the local x.

    Cox-de Boor on polynomials: u = a + h x on the span [a, a + h].
    """
    a, h = knots[span], knots[span + 1] - knots[span]
    functions = {span: np.eye(1, degree + 1)[0]}
    for r in range(1, degree + 1):
        higher = {}
        for i in range(span - r, span + 1):
            out = np.zeros(degree + 1)
            if i in functions and knots[i + r] > knots[i]:
                out += _times(functions[i], a - knots[i], h) / (knots[i + r] - knots[i])
            if i + 1 in functions and knots[i + r + 1] > knots[i + 1]:
                ends = knots[i + r + 1]
                out += _times(functions[i + 1], ends - a, -h) / (ends - knots[i + 1])
            higher[i] = out
        functions = higher
    return np.stack([functions[i] for i in range(span - degree, span + 1)])


def _times(poly: np.ndarray, constant: float, slope: float) -> np.ndarray:
    """poly * (constant + slope x), same length (the top coefficient is zero by construction)."""
    out = constant * poly
    out[1:] += slope * poly[:-1]
    return out
