"""Half spaces in boxes: volume and interface area, exact, with gradients.

Thesis eq. 4.72 gives the volume of a half space in the unit cube as

    |[0,1]^d and {a.x + b >= 0}| = sum_q (-1)^(zeros of q) max(a.q + b, 0)^d / (d! prod_i a_i)

over the corners q, and eq. 4.74 the area of the plane as the derivative in b times |a|. Both divide
by every component of a, so they fail, or lose digits to cancellation, where one vanishes. Here the
sum is taken apart instead: mirrored so that a >= 0 and at most half of the cube lies below the
plane, sorted, scaled to sum a_i = 1, and divided through by hand piece by piece. What remains has
no difference of large terms, and is right to rounding for any a, zeros included.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

_TINY = 1e-100  # keeps divisions and their derivatives finite in pieces that are not taken


class Plane(NamedTuple):
    """The plane slope . x + offset = 0 in a cell's coordinates x in [0, 1]^dim; fluid above zero.

    Attributes:
        slope: (..., dim) [unit of phi].
        offset: Value at the low corner, (...,) [unit of phi].
    """

    slope: Tensor
    offset: Tensor


def fit_plane(corners: Tensor) -> Plane:
    """Plane that fits corner values best (least squares).

    Args:
        corners: Level set at the corners of cells, (..., 2, 2) or (..., 2, 2, 2): one axis per
            direction after the batch; the batch must have exactly one axis.

    Returns:
        ``Plane``. Gradient: corners (linear).
    """
    dim = corners.ndim - 1
    if dim not in (2, 3) or corners.shape[1:] != (2,) * dim:
        raise ValueError(f"corners must have shape (n, 2, 2) or (n, 2, 2, 2), got {corners.shape}")
    slope = torch.stack(
        [
            (corners.select(1 + a, 1) - corners.select(1 + a, 0)).flatten(1).mean(1)
            for a in range(dim)
        ],
        dim=-1,
    )
    return Plane(slope, corners.flatten(1).mean(1) - 0.5 * slope.sum(-1))


def cut_volume(plane: Plane) -> Tensor:
    """Share of the unit cell on the positive side of a plane (thesis eq. 4.72), in [0, 1].

    A cell whose slope is zero is full where the offset is positive and empty elsewhere.

    Args:
        plane: ``Plane`` of any batch shape.

    Returns:
        (...,) [-]. Gradient: slope and offset; once continuously differentiable except where a
        plane parallel to a face passes it (a kink in the offset).
    """
    pieces = _Pieces(plane)
    below = pieces.volume()
    share = torch.where(pieces.half_below, below, 1.0 - below)
    return torch.where(pieces.flat, (plane.offset > 0).to(share.dtype), share)


def cut_area(plane: Plane, spacing: Sequence[float] | None = None) -> Tensor:
    """Area of a plane within a cell (thesis eq. 4.74); length in 2D.

    A plane in a cell's face belongs to the cell on its positive side.

    Args:
        plane: ``Plane`` of any batch shape.
        spacing: Cell size per axis [m]; default the unit cell.

    Returns:
        (...,) [m^(dim-1)]. Gradient: slope and offset; jumps where a plane parallel to a face
        passes it, and in 2D has a kink where the line passes a corner.
    """
    pieces = _Pieces(plane)
    sizes = plane.slope.new_tensor(spacing or [1.0] * plane.slope.shape[-1])
    gradient = (
        torch.where(pieces.flat[..., None], torch.ones_like(plane.slope), plane.slope) / sizes
    )
    area = pieces.slope() / pieces.total * gradient.norm(dim=-1) * sizes.prod()
    return torch.where(pieces.flat | pieces.empty, torch.zeros_like(area), area)


class _Pieces:
    """A plane mirrored, sorted and scaled: m1 <= m2 <= m3, sum 1, level c <= 1/2 (m1 = 0 in 2D).

    The volume below level c in the unit cube is sum_q (-1)^|q| max(c - m.q, 0)^3 / (6 m1 m2 m3).
    Its terms are paired so that m1 divides out: with G(x) = (x+^3 - (x - m1)+^3) / m1,

        V = (G(c) - G(c - m2) - G(c - m3)) / (6 m2 m3)   where c < m1 + m2,
        V = (2 c - m1 - m2) / (2 m3)                     where m1 + m2 <= c <= m3.
    """

    def __init__(self, plane: Plane):
        slope, offset = plane
        self.flat = (slope == 0).all(-1)
        size = slope.abs()
        total = size.sum(-1)
        self.total = torch.where(self.flat, torch.ones_like(total), total)
        center = (offset + 0.5 * slope.sum(-1)) / self.total
        m = (size / self.total[..., None]).sort(dim=-1).values
        self.m3, self.m2 = m[..., -1], m[..., -2]
        self.m1 = m[..., 0] if slope.shape[-1] == 3 else torch.zeros_like(self.m2)
        # Half the volume or more lies on the other side: measure what is left over. ``where`` and
        # not ``abs``, whose derivative at zero is zero.
        self.half_below = center <= 0
        self.empty = center <= -0.5
        spare = torch.where(self.half_below, center, -center)  # <= 0
        # From the sum of m and not from 1/2, so that c = m1 + m2 etc. hold where they should.
        self.c = spare + 0.5
        self.wide = self.c >= self.m1 + self.m2  # the linear piece; also c = 0 = m1 = m2
        self.wide &= self.m1 + self.m2 <= self.m3

    def volume(self) -> Tensor:
        m1, m2, m3, c = self.m1, self.m2, self.m3, self.c
        cubic = self._near(c, 3) - self._near(c - m2, 3) - self._near(c - m3, 3)
        cubic = cubic / (6.0 * m2.clamp(min=_TINY) * m3.clamp(min=_TINY))
        linear = (2.0 * c - m1 - m2) / (2.0 * m3.clamp(min=_TINY))
        value = torch.where(self.wide, linear, cubic)
        return torch.where(c >= 0, value, torch.zeros_like(value))

    def slope(self) -> Tensor:
        """Derivative of ``volume`` in c."""
        m2, m3, c = self.m2, self.m3, self.c
        square = self._near(c, 2) - self._near(c - m2, 2) - self._near(c - m3, 2)
        square = square / (2.0 * m2.clamp(min=_TINY) * m3.clamp(min=_TINY))
        value = torch.where(self.wide, 1.0 / m3.clamp(min=_TINY), square)
        return torch.where(c >= 0, value, torch.zeros_like(value))

    def _near(self, x: Tensor, power: int) -> Tensor:
        """(x+^p - (x - m1)+^p) / m1 for p = 3 (that is G) or 2 (G' / 3)."""
        m1 = self.m1
        inner = torch.minimum(x.clamp(min=0.0), m1)
        ratio = inner / torch.where(m1 > 0, m1, torch.ones_like(m1))  # in [0, 1]
        if power == 3:
            beyond, within = 3.0 * x * (x - m1) + m1 * m1, inner * inner * ratio
        else:
            beyond, within = 2.0 * x - m1, inner * ratio
        return torch.where(x >= m1, torch.where(x >= 0, beyond, within), within)
