"""Signed distance to a closed triangle surface, without any further package.

The sign is that of the angle-weighted pseudonormal at the closest point: Baerentzen, Aanaes 2005,
"Signed Distance Computation Using the Angle Weighted Pseudonormal".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diffsim.core.arrays import Array, IntArray
from diffsim.core.checked import checked
from diffsim.mesh.closed_surface import SurfaceLike, closed_surface

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_CHUNK = 20_000
_MAX_PIECES = 400_000
_FEW_PAIRS = 500_000
"""Up to so many pairs of points and triangles, comparing all is faster than a tree."""


class Nearest(NamedTuple):
    """The closest feature of a surface for each point."""

    face: IntArray  # index of the closest triangle, (N,) int64
    feature: IntArray  # its corner 0..2, edge 01, 12, 20 as 3..5, or 6 for its inside, (N,) int64
    sign: Array  # -1 inside the surface, 1 outside, (N,)
    distance: Array  # not signed, (N,) [m]
    normal: Array  # pseudonormal of the feature, not normalized, (N, 3)


class SurfaceDistance:
    """Callable (N, 3) -> (N,) [m], negative inside a closed surface."""

    @checked
    def __init__(self, surface: SurfaceLike):
        """Take a watertight trimesh or the path of a surface file."""
        self._prepare(*closed_surface(surface))

    @classmethod
    @checked
    def of_triangles(cls, x: Array, faces: IntArray) -> SurfaceDistance:
        """Distance to triangles (F, 3) of vertices (V, 3) [m], known to be closed and outwards."""
        made = cls.__new__(cls)
        made._prepare(x, faces)
        return made

    def _prepare(self, x: Array, faces: IntArray) -> None:
        self.x, self.faces = x, faces
        corners = self.x[self.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        self._normal = normal / np.where(length > 0, length, 1.0)
        self._set_pseudonormals(corners)
        self._center = corners.mean(axis=1)
        self._radius = np.linalg.norm(corners - self._center[:, None], axis=2).max(axis=1)
        self._tree: cKDTree | None = None  # made for the first large search

    def _plant(self) -> cKDTree:
        from scipy.spatial import cKDTree

        pieces, self._parent = _pieces(self.x[self.faces])
        centers = pieces.mean(axis=1)
        self._reach = float(np.linalg.norm(pieces - centers[:, None], axis=2).max())
        return cKDTree(centers)

    @checked
    def __call__(self, points: Array) -> Array:
        """Signed distance of points, (N, 3) [m] -> (N,) [m]."""
        near = self.nearest(points)
        return near.sign * near.distance

    @checked
    def nearest(self, points: Array) -> Nearest:
        """The closest feature of the surface for points (N, 3) [m]."""
        points = np.asarray(points, np.float64)
        starts = range(0, max(len(points), 1), _CHUNK)
        parts = [self._nearest(points[start : start + _CHUNK]) for start in starts]
        return Nearest(*(np.concatenate(part) for part in zip(*parts, strict=True)))

    def _nearest(self, points: Array) -> Nearest:
        if not len(points):
            none, empty = np.empty(0, np.int64), np.empty(0)
            return Nearest(none, none, empty, empty, np.empty((0, 3)))
        few = len(points) * len(self.faces) <= _FEW_PAIRS
        point, face = self._compare(points) if few else self._search(points)
        closest, feature = _closest(points[point], self.x[self.faces[face]])
        away = points[point] - closest
        squared = (away * away).sum(axis=1)
        order = np.lexsort((squared, point))
        best = order[np.unique(point[order], return_index=True)[1]]
        normal = self._pseudonormal[face[best], feature[best]]
        sign = np.where((away[best] * normal).sum(axis=1) < 0, -1.0, 1.0)
        return Nearest(face[best], feature[best], sign, np.sqrt(squared[best]), normal)

    def _compare(self, points: Array) -> tuple[IntArray, IntArray]:
        """Pairs (point, face) that can be closest, by a bounding sphere of every triangle."""
        away = np.linalg.norm(points[:, None] - self._center, axis=2)
        farthest = (away + self._radius).min(axis=1, keepdims=True)
        point, face = np.nonzero(away - self._radius <= farthest * (1.0 + 1e-12))
        return point, face

    def _search(self, points: Array) -> tuple[IntArray, IntArray]:
        """The same by a tree of pieces of triangles."""
        if self._tree is None:
            self._tree = self._plant()
        _, nearest = self._tree.query(points)
        guess, _ = _closest(points, self.x[self.faces[self._parent[nearest]]])
        near = np.linalg.norm(points - guess, axis=1)
        # the closest triangle has a piece whose center is no farther than this
        found = self._tree.query_ball_point(
            points, near * (1.0 + 1e-12) + self._reach, return_sorted=False
        )
        count = np.array([len(f) for f in found])
        point = np.repeat(np.arange(len(points)), count)
        piece = np.concatenate([np.asarray(f, np.int64) for f in found])
        pairs = np.unique(point * len(self.faces) + self._parent[piece])
        return pairs // len(self.faces), pairs % len(self.faces)

    def _set_pseudonormals(self, corners: Array) -> None:
        """Normals of the seven features of each triangle: corners, edges 01 12 20, inside."""
        num = len(self.x)
        at_vertex = np.zeros((num, 3))
        for c in range(3):
            a = corners[:, (c + 1) % 3] - corners[:, c]
            b = corners[:, (c + 2) % 3] - corners[:, c]
            angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1))
            np.add.at(at_vertex, self.faces[:, c], angle[:, None] * self._normal)
        ends = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
        _, edge = np.unique(ends[..., 0] * num + ends[..., 1], return_inverse=True)
        edge = edge.reshape(-1, 3)
        at_edge = np.zeros((int(edge.max()) + 1, 3))
        for c in range(3):
            np.add.at(at_edge, edge[:, c], self._normal)
        self._pseudonormal = np.concatenate(
            [at_vertex[self.faces], at_edge[edge], self._normal[:, None]], axis=1
        )


def _pieces(corners: Array) -> tuple[Array, IntArray]:
    """Halve long triangles, so that a search by piece centers looks at few: pieces, parents."""
    parent = np.arange(len(corners))
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    diagonal = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    target = max(min(2.0 * float(np.median(edge)), diagonal / 40.0), float(edge.max()) / 64.0)
    done: list[Array] = []
    owners: list[IntArray] = []
    while len(corners):
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        longest = sides.argmax(axis=1)
        big = sides.max(axis=1) > target
        if 2 * len(corners) + sum(len(d) for d in done) > _MAX_PIECES:
            big[:] = False
        done.append(corners[~big])
        owners.append(parent[~big])
        rows = np.arange(int(big.sum()))
        c, k = corners[big], longest[big]
        a, b, tip = c[rows, k], c[rows, (k + 1) % 3], c[rows, (k + 2) % 3]
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, tip], 1), np.stack([middle, b, tip], 1)])
        parent = np.tile(parent[big], 2)
    return np.concatenate(done), np.concatenate(owners)


def _closest(p: Array, corners: Array) -> tuple[Array, IntArray]:
    """Closest point of triangles (N, 3, 3) to points (N, 3), and its feature 0..6."""
    best = np.empty_like(p)
    feature = np.full(len(p), 6)
    squared = np.full(len(p), np.inf)
    for c in range(3):  # the three sides, their ends included
        a, b = corners[:, c], corners[:, (c + 1) % 3]
        d = b - a
        length = np.maximum((d * d).sum(axis=1), 1e-300)
        t = np.clip(((p - a) * d).sum(axis=1) / length, 0.0, 1.0)
        q = a + t[:, None] * d
        distance = ((p - q) ** 2).sum(axis=1)
        nearer = distance < squared
        best[nearer], squared[nearer] = q[nearer], distance[nearer]
        kind = np.where(t <= 0.0, c, np.where(t >= 1.0, (c + 1) % 3, 3 + c))
        feature[nearer] = kind[nearer]
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e, f)
    area = np.maximum((normal * normal).sum(axis=1), 1e-300)
    r = p - corners[:, 0]
    u = (np.cross(r, f) * normal).sum(axis=1) / area
    v = (np.cross(e, r) * normal).sum(axis=1) / area
    over = (u > 0) & (v > 0) & (u + v < 1)  # the foot of the normal is inside: nothing is nearer
    best[over] = (corners[:, 0] + u[:, None] * e + v[:, None] * f)[over]
    feature[over] = 6
    return best, feature
