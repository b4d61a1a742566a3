"""A watertight triangle surface as a solid."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.contact.shapes import Pair, Shape
from diffsim.contact.triangles import feature_distance
from diffsim.mesh import HexMesh, SurfaceDistance, TetMesh, to_trimesh
from diffsim.mesh.closed_surface import SurfaceLike


class MeshShape(Shape):
    """Solid within a watertight surface; the exact distance to its triangles.

    phi is continuous. The normal is constant next to a triangle's inside, turns around convex
    edges and corners outside the solid (concave ones inside), and jumps across the medial axis;
    on an edge or corner it is the angle-weighted pseudonormal, with zero gradient.

    Args:
        surface: Watertight ``trimesh.Trimesh``, the path of a surface file, or a volume mesh of
            ours, whose boundary is taken [m]. Vertices carry no gradient; the obstacle's pose does.

    Raises:
        MeshError: the surface is not closed.
    """

    def __init__(self, surface: SurfaceLike | HexMesh | TetMesh, *, inside_out: bool = False):
        super().__init__(inside_out)
        if isinstance(surface, (HexMesh, TetMesh)):
            surface = to_trimesh(surface)
        self.distance = SurfaceDistance(surface)
        self._corners = torch.from_numpy(self.distance.x[self.distance.faces])

    def _solid(self, x: Tensor) -> Pair:
        flat = x.reshape(-1, 3)
        near = self.distance.nearest(flat.detach().numpy())
        phi, normal, _ = feature_distance(
            flat,
            self._corners[torch.from_numpy(near.face)],
            torch.from_numpy(near.feature),
            torch.from_numpy(near.sign),
            torch.from_numpy(near.normal),
        )
        return phi.reshape(x.shape[:-1]), normal.reshape(x.shape)
