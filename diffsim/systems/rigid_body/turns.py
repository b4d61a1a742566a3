"""Quaternions, scalar part first."""

from __future__ import annotations

import torch
from torch import Tensor


def exponential(turn: Tensor) -> Tensor:
    """Quaternion (..., 4), scalar first, of a rotation vector (..., 3)."""
    half = 0.5 * turn.square().sum(-1, keepdim=True).clamp(min=1e-24).sqrt()
    return torch.cat([half.cos(), 0.5 * turn * torch.sinc(half / torch.pi)], -1)


def times(a: Tensor, b: Tensor) -> Tensor:
    """Quaternion product."""
    s, u, t, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    u, v = torch.broadcast_tensors(u, v)
    vector = s * v + t * u + torch.linalg.cross(u, v)
    return torch.cat([s * t - (u * v).sum(-1, keepdim=True), vector], -1)


def conjugate(q: Tensor) -> Tensor:
    """The turn back."""
    return torch.cat([q[..., :1], -q[..., 1:]], -1)


def rotate(q: Tensor, x: Tensor) -> Tensor:
    """Body vectors (..., 3) in the world."""
    q, x = torch.broadcast_tensors(q, torch.cat([torch.zeros_like(x[..., :1]), x], -1))
    return times(times(q, x), conjugate(q))[..., 1:]
