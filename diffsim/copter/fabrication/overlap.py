"""Parts that interpenetrate: what no workshop can put together."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked
from diffsim.mesh.distance import SurfaceDistance

if TYPE_CHECKING:
    import trimesh

LEAST_DEPTH = 5e-4
"""Parts that go less into each other touch: saw and printer are no more precise [m]."""
_MOST_POINTS = 6_000  # of a pair; beyond them the deepest point met so far is taken
_BATCH = 200  # points at a time, those in the deepest boxes first
_CORNERS = np.array(
    [[4, 4, 4], [8, 2, 2], [2, 8, 2], [2, 2, 8], [1, 5.5, 5.5], [5.5, 1, 5.5], [5.5, 5.5, 1]]
) / np.array([12.0])  # barycentric coordinates of points of a triangle
_CORNERS = _CORNERS / _CORNERS.sum(axis=1, keepdims=True)


@checked(kinds_only=True)
@dataclass(frozen=True)
class Overlap:
    """Two parts that share space.

    Attributes:
        parts: Their names.
        depth: Greatest distance from a shared point to the nearer one of the two surfaces [m].
        place: That point in the design's frame, (3,) [m].
    """

    parts: tuple[str, str]
    depth: float
    place: tuple[float, float, float]

    def __str__(self) -> str:
        place = ", ".join(f"{1e3 * p:.0f}" for p in self.place)
        return (
            f"{self.parts[0]} and {self.parts[1]} go into each other by {1e3 * self.depth:.1f} mm "
            f"at ({place}) mm"
        )


@checked
def overlaps(
    meshes: Mapping[str, trimesh.Trimesh], least: float = LEAST_DEPTH
) -> tuple[Overlap, ...]:
    """Every pair of parts that share a point deeper than ``least`` in both.

    Args:
        meshes: Closed surfaces by name, in one frame [m].
        least: Depth below which parts count as touching [m].

    Returns:
        The deepest first.
    """
    solids = {name: _Solid(mesh) for name, mesh in meshes.items()}
    found = []
    for a, b in itertools.combinations(meshes, 2):
        low = np.maximum(meshes[a].bounds[0], meshes[b].bounds[0])
        high = np.minimum(meshes[a].bounds[1], meshes[b].bounds[1])
        if (high - low <= least).any() or not _may_share(solids[a], solids[b], low, high, least):
            continue
        depth, place = _deepest(solids[a].distance, solids[b].distance, low, high, least)
        if depth > least:
            x, y, z = place.tolist()
            found.append(Overlap((a, b), depth, (x, y, z)))
    return tuple(sorted(found, key=lambda o: -o.depth))


class _Solid:
    """A closed surface, and what is asked of it."""

    def __init__(self, mesh: trimesh.Trimesh):
        x, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int64)
        self.distance = SurfaceDistance.of_triangles(x, faces)
        self.triangles = x[faces]
        self.normals = np.cross(
            self.triangles[:, 1] - self.triangles[:, 0], self.triangles[:, 2] - self.triangles[:, 0]
        )
        self.normals /= np.maximum(np.linalg.norm(self.normals, axis=1, keepdims=True), 1e-300)
        sides = np.roll(self.triangles, -1, axis=1) - self.triangles
        sides /= np.maximum(np.linalg.norm(sides, axis=2, keepdims=True), 1e-300)
        self.inward = np.cross(self.normals[:, None], sides)  # in the triangle's plane, off a side
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        self.edges = x[np.unique(edges, axis=0)]

    def skin(self, depth: float) -> Array:
        """Points below the surface, seven for each triangle, (n, 3)."""
        points = np.einsum("pk,fkx->fpx", _CORNERS, self.triangles)
        return (points - depth * self.normals[:, None]).reshape(-1, 3)


def _may_share(a: _Solid, b: _Solid, low: Array, high: Array, least: float) -> bool:
    """Whether an edge of one pierces the other, or points below one's surface lie in the other.

    Parts that only touch do neither, and are told apart from those that overlap at little cost.
    """
    if _pierces(a, b, low, high, least) or _pierces(b, a, low, high, least):
        return True
    for one, other in ((a, b), (b, a)):
        points = one.skin(least)
        points = points[((points > low) & (points < high)).all(axis=1)]
        if len(points) and bool((other.distance(points) < -0.5 * least).any()):
            return True
    return False


def _pierces(a: _Solid, b: _Solid, low: Array, high: Array, least: float) -> bool:
    """Whether an edge of a crosses a triangle of b, ``least`` away from its ends and its sides."""
    low, high = low - least, high + least  # edges along the sides of the box count
    near = ((a.edges.min(axis=1) < high) & (a.edges.max(axis=1) > low)).all(axis=1)
    ends = a.edges[near]
    near = ((b.triangles.min(axis=1) < high) & (b.triangles.max(axis=1) > low)).all(axis=1)
    walls = zip(b.triangles[near], b.normals[near], b.inward[near], strict=True)
    for corners, normal, inward in walls:
        height = (ends - corners[0]) @ normal
        crossing = (height.min(axis=1) < -least) & (height.max(axis=1) > least)
        if not crossing.any():
            continue
        h, e = height[crossing], ends[crossing]
        share = (h[:, 0] / (h[:, 0] - h[:, 1]))[:, None]
        point = e[:, 0] + share * (e[:, 1] - e[:, 0])
        inside = np.ones(len(point), bool)
        for k in range(3):
            inside &= (point - corners[k]) @ inward[k] > least
        if inside.any():
            return True
    return False


def _deepest(
    a: SurfaceDistance, b: SurfaceDistance, low: Array, high: Array, least: float
) -> tuple[float, Array]:
    """Greatest depth of a point in both solids, about to a fifth of itself, and that point.

    The depth changes by no more than the distance that a point moves. So a box cannot hold a deep
    point if its middle lies further outside than its corners are away: boxes are halved until they
    are left out.
    """
    edge = max(float((high - low).min()), least)
    counts = np.maximum(np.ceil((high - low) / edge).astype(int), 1)
    size = (high - low) / counts
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), -1)
    middles = low + (grid.reshape(-1, 3) + 0.5) * size
    half = np.full(len(middles), 0.5)  # of a box, in sizes of the first ones
    parent = np.zeros(len(middles))  # depth of the middle of the box that it is a part of
    best, place, spent = 0.0, low, 0
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=3))) * size
    while len(middles) and spent < _MOST_POINTS:
        order = np.argsort(-parent, kind="stable")
        now, rest = order[:_BATCH], order[_BATCH:]
        spent += len(now)
        x, depth, reach = middles[now], np.full(len(now), -np.inf), half[now]
        reach = reach * float(np.linalg.norm(size))
        promising = np.ones(len(now), bool)
        for solid in (a, b):  # the second only where the first leaves hope
            inside = -solid(x[promising])
            depth[promising] = np.where(
                np.isinf(depth[promising]), inside, np.minimum(depth[promising], inside)
            )
            promising &= depth + reach > max(1.2 * best, least)
        if promising.any() and depth[promising].max() > best:
            deepest = int(np.where(promising, depth, -np.inf).argmax())
            best, place = float(depth[deepest]), x[deepest]
        promising &= depth + reach > max(1.2 * best, least)
        quarter = 0.5 * half[now][promising]
        parts = x[promising, None] + quarter[:, None, None] * corners
        middles = np.concatenate([middles[rest], parts.reshape(-1, 3)])
        half = np.concatenate([half[rest], np.repeat(quarter, 8)])
        parent = np.concatenate([parent[rest], np.repeat(depth[promising], 8)])
    return best, place
