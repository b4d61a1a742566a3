"""Whether a polyline in the plane crosses itself."""

from __future__ import annotations

import torch
from torch import Tensor


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
