"""Two deformable bodies against each other: penalty contact of nodes with triangles."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from diffsim.contact.triangles import feature_distance
from diffsim.core.check import require
from diffsim.core.module import Float64Module
from diffsim.core.numbers import require_unmapped, to_numpy
from diffsim.core.torch_names import on_constants
from diffsim.core.values import Number, dot, scalar
from diffsim.mesh import HexMesh, SurfaceDistance, TetMesh, surface_triangles

_Mesh = HexMesh | TetMesh


class BodyContact(Float64Module):
    """Contact forces between two bodies: surface nodes of each against the triangles of the other.

    A node at depth d below the other's deformed surface, n that surface's outward normal, v_n and
    u the normal and tangential parts of their relative velocity there, area the node's share of its
    own body's rest surface:

    fn = 1/2 stiffness area d max(0, 1 - damping v_n),
    f = fn (n - friction u / sqrt(|u|^2 + slip_speed^2)),

    and -f on the closest triangle's corners by barycentric weights (1/2: both bodies' nodes act).
    The couple d n x f that is left, as friction acts at the node and at the surface point, is
    taken by a third set of forces on the triangle's corners, the least that have no resultant. So
    linear and angular momentum are kept to rounding.

    Friction is regularized: below ``slip_speed`` it is viscous and bodies creep on each other. The
    force is explicit: stable only while stiffness * area is small against node mass / dt^2. A node
    deeper than half its thin opponent is pushed out on the wrong side.

    Args:
        mesh_a, mesh_b: The bodies' meshes.
        stiffness: Pressure per depth [Pa/m], >= 0; independent of the meshes.
        damping: Damping of the normal force (Hunt, Crossley 1975), >= 0 [s/m].
        friction: Coulomb coefficient, >= 0 [-].
        slip_speed: Speed at which friction has 71 % of its full value, > 0 [m/s].
    """

    def __init__(
        self,
        mesh_a: _Mesh,
        mesh_b: _Mesh,
        *,
        stiffness: Number,
        damping: Number = 0.0,
        friction: Number = 0.0,
        slip_speed: Number = 1e-3,
    ):
        super().__init__()
        self._a, self._b = _Skin("mesh_a", mesh_a), _Skin("mesh_b", mesh_b)
        self.stiffness = scalar("stiffness", stiffness, at_least=0.0)
        self.damping = scalar("damping", damping, at_least=0.0)
        self.friction = scalar("friction", friction, at_least=0.0)
        self.slip_speed = scalar("slip_speed", slip_speed, above=0.0)

    def forward(self, x_a: Tensor, v_a: Tensor, x_b: Tensor, v_b: Tensor) -> tuple[Tensor, Tensor]:
        """Forces on both bodies.

        Args:
            x_a, v_a: Positions [m] and velocities [m/s] of body a, (..., num_nodes_a, 3).
            x_b, v_b: Positions [m] and velocities [m/s] of body b, (..., num_nodes_b, 3), with
                the same batch axes.

        Returns:
            Forces on a and b, shapes of x_a and x_b [N]. Gradients: positions, velocities and all
            coefficients; first order; which triangle is closest is piecewise constant.
        """
        x_a = require("x_a", x_a, ("...", self._a.num_nodes, 3))
        v_a = require("v_a", v_a, tuple(x_a.shape))
        x_b = require("x_b", x_b, (*x_a.shape[:-2], self._b.num_nodes, 3))
        v_b = require("v_b", v_b, tuple(x_b.shape))
        require_unmapped(x_a=x_a, x_b=x_b)
        if x_a.ndim == 2:
            return self._pair(x_a, v_a, x_b, v_b)
        flat = [t.reshape(-1, *t.shape[-2:]) for t in (x_a, v_a, x_b, v_b)]
        pairs = [self._pair(*single) for single in zip(*flat, strict=True)]
        if not pairs:
            return torch.zeros_like(x_a), torch.zeros_like(x_b)
        on_a, on_b = (torch.stack(side) for side in zip(*pairs, strict=True))
        return on_a.reshape(x_a.shape), on_b.reshape(x_b.shape)

    def _pair(self, x_a: Tensor, v_a: Tensor, x_b: Tensor, v_b: Tensor) -> tuple[Tensor, Tensor]:
        on_a, on_b = torch.zeros_like(x_a), torch.zeros_like(x_b)
        box = _overlap(self._a, x_a, self._b, x_b)
        if box is not None:
            a, b = _Moving(skin=self._a, x=x_a, v=v_a), _Moving(skin=self._b, x=x_b, v=v_b)
            on_a, on_b = self._half(a, b, on_a, on_b, box)
            on_b, on_a = self._half(b, a, on_b, on_a, box)
        return on_a, on_b

    def _half(
        self, own: _Moving, other: _Moving, on_own: Tensor, on_other: Tensor, box: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Add the forces of ``own``'s nodes that are inside ``other``."""
        x = own.x
        local = other.skin.touching(other.x, own.skin.vertices, x, box)
        if local is None:
            return on_own, on_other
        rows, face, feature, pseudonormal = local
        node, corner = own.skin.vertices[rows], other.skin.faces[face]
        triangle = other.x[corner]
        sign = -torch.ones(len(rows), dtype=x.dtype)
        phi, n, weights = feature_distance(x[node], triangle, feature, sign, pseudonormal)
        relative = own.v[node] - (weights[:, :, None] * other.v[corner]).sum(1)
        v_n = dot(relative, n)
        u = relative - v_n[:, None] * n
        fn = 0.5 * self.stiffness * own.skin.area[rows] * -phi
        fn = fn * (1.0 - self.damping * v_n).clamp(min=0.0)
        grip = self.friction / (dot(u, u) + self.slip_speed**2).sqrt()
        force = fn[:, None] * (n - grip[:, None] * u)
        surface_point = (weights[:, :, None] * triangle).sum(1)
        couple = torch.linalg.cross(surface_point - x[node], force)
        reaction = _couple_forces(triangle, couple) - weights[:, :, None] * force[:, None]
        on_own = on_own.index_add(0, node, force)
        on_other = on_other.index_add(0, corner.reshape(-1), reaction.reshape(-1, 3))
        return on_own, on_other


class _Skin:
    """Surface of one body: triangles, nodes, and each node's share of the rest area."""

    @on_constants()
    def __init__(self, name: str, mesh: _Mesh):
        if not isinstance(mesh, (HexMesh, TetMesh)):
            raise TypeError(f"{name} must be a HexMesh or TetMesh, got {type(mesh).__name__}")
        self.num_nodes = mesh.num_nodes
        self.faces = surface_triangles(mesh).faces
        self.vertices, local = torch.unique(self.faces, return_inverse=True)
        self._local_faces = local.numpy()
        corners = mesh.x_rest[self.faces]
        edges = corners[:, 1:] - corners[:, :1]
        area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=1)
        third = (area / 3.0)[:, None].expand(-1, 3).reshape(-1)
        self.area = torch.zeros(len(self.vertices), dtype=area.dtype)
        self.area.index_add_(0, local.reshape(-1), third)

    def bounds(self, x: Tensor) -> tuple[Tensor, Tensor]:
        on_surface = x[self.vertices]
        return on_surface.min(0).values, on_surface.max(0).values

    @torch.no_grad()
    def touching(
        self, y: Tensor, nodes: Tensor, x: Tensor, box: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
        """Which of the other body's ``nodes`` are inside: rows, faces, features, pseudonormals."""
        p = x[nodes]
        rows = torch.nonzero(((p >= box[0]) & (p <= box[1])).all(1)).flatten()
        if not len(rows):
            return None
        surface = SurfaceDistance.of_triangles(to_numpy("x", y[self.vertices]), self._local_faces)
        near = surface.nearest(to_numpy("x", p[rows]))
        inside = torch.from_numpy(near.sign < 0)
        if not bool(inside.any()):
            return None
        return (
            rows[inside],
            torch.from_numpy(near.face)[inside],
            torch.from_numpy(near.feature)[inside],
            torch.from_numpy(near.normal)[inside],
        )


class _Moving(NamedTuple):
    """A body's surface with its positions [m] and velocities [m/s], (num_nodes, 3)."""

    skin: _Skin
    x: Tensor
    v: Tensor


@torch.no_grad()
def _overlap(a: _Skin, x_a: Tensor, b: _Skin, x_b: Tensor) -> Tensor | None:
    """The part that the two bounding boxes share, (2, 3) [m]; None where they are apart."""
    (low_a, high_a), (low_b, high_b) = a.bounds(x_a), b.bounds(x_b)
    low, high = torch.maximum(low_a, low_b), torch.minimum(high_a, high_b)
    return torch.stack([low, high]) if bool((low <= high).all()) else None


def _couple_forces(triangle: Tensor, couple: Tensor) -> Tensor:
    """The least forces on corners (N, 3, 3) that have a couple (N, 3) and no resultant.

    g_k = omega x r_k with r_k from the centroid, J omega = couple, J = sum |r|^2 I - r r'. For a
    couple in the triangle's plane these are normal forces, linear over the triangle.
    """
    r = triangle - triangle.mean(1, keepdim=True)
    outer = torch.einsum("nki,nkj->nij", r, r)
    trace = outer.diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    omega = torch.linalg.solve(trace * torch.eye(3, dtype=r.dtype) - outer, couple)
    return torch.linalg.cross(omega[:, None].expand_as(r), r)
