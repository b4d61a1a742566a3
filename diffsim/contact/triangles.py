"""Distance to one given feature of a triangle: which feature is closest was found without torch."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.core.values import direction, dot

_NEXT = [1, 2, 0]


def barycentric(p: Tensor, corners: Tensor, feature: Tensor) -> Tensor:
    """Weights of a triangle's corners that give the closest point on one of its features.

    Args:
        p: Points, (N, 3) [m].
        corners: Corners of the triangles, (N, 3, 3) [m].
        feature: Feature: 0, 1, 2 corners; 3, 4, 5 edges 01, 12, 20; 6 the inside, (N,) int64, as
            :meth:`diffsim.mesh.SurfaceDistance.nearest` gives them.

    Returns:
        Weights, (N, 3), sum 1. Gradients: p, corners.
    """
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = torch.linalg.cross(e, f)
    area, r = dot(normal, normal), p - corners[:, 0]
    u = dot(torch.linalg.cross(r, f), normal) / area
    v = dot(torch.linalg.cross(e, r), normal) / area
    weights = torch.stack([1.0 - u - v, u, v], dim=1)
    unit = torch.eye(3, dtype=p.dtype)
    for c in range(3):
        side = corners[:, _NEXT[c]] - corners[:, c]
        t = (dot(p - corners[:, c], side) / dot(side, side))[:, None]
        on_edge = (1.0 - t) * unit[c] + t * unit[_NEXT[c]]
        weights = torch.where((feature == 3 + c)[:, None], on_edge, weights)
        weights = torch.where((feature == c)[:, None], unit[c], weights)
    return weights


def feature_distance(
    p: Tensor, corners: Tensor, feature: Tensor, sign: Tensor, pseudonormal: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Signed distance, normal and barycentric weights of the closest point.

    Args:
        p: Points, (N, 3) [m].
        corners: Corners of the triangles, (N, 3, 3) [m], counter-clockwise seen from outside.
        feature: Feature of each triangle, (N,) int64, as in :func:`barycentric`.
        sign: Side of the surface, -1 inside, 1 outside, (N,).
        pseudonormal: Normal where a point lies on an edge or corner, (N, 3), not zero.

    Returns:
        phi (N,) [m], normal (N, 3), weights (N, 3). Gradients: p and corners; first order.
    """
    weights = barycentric(p, corners, feature)
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    face = torch.linalg.cross(e, f)
    face = face / face.norm(dim=1, keepdim=True)
    size = corners.detach().abs().max() if len(p) else corners.new_ones(())
    away = p - (weights[:, :, None] * corners).sum(1)
    fallback = (sign[:, None] * pseudonormal).detach()
    length, outwards = direction(away, fallback, tiny=1e-12 * size)
    flat = feature == 6
    phi = torch.where(flat, dot(p - corners[:, 0], face), sign * length)
    return phi, torch.where(flat[:, None], face, sign[:, None] * outwards), weights
