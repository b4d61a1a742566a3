"""A watertight triangle surface as a solid."""

from __future__ import annotations

import torch
from torch import Tensor

from diffsim.contact.handles import shape_of
from diffsim.contact.shapes import Pair, Shape
from diffsim.contact.triangles import feature_distance
from diffsim.core.checked import checked
from diffsim.core.layer import custom_op
from diffsim.core.numbers import to_numpy
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

    @checked(x=("N", 3))
    def nearest(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Closest face, its feature, side and pseudonormal of points (N, 3) [m]; no gradient."""
        near = self.distance.nearest(to_numpy("x", x))
        found = (near.face, near.feature, near.sign, near.normal)
        face, feature, sign, normal = (torch.from_numpy(array) for array in found)
        return face, feature, sign, normal

    def _solid(self, x: Tensor) -> Pair:
        flat = x.reshape(-1, 3)
        if torch.compiler.is_compiling():
            face, *near = nearest_in_graph(flat.detach(), handle=self.handle)
        else:
            face, *near = self.nearest(flat)
        phi, normal, _ = feature_distance(flat, self._corners[face], *near)
        return phi.reshape(x.shape[:-1]), normal.reshape(x.shape)


@custom_op("diffsim::contact_nearest")
def nearest_in_graph(x: Tensor, *, handle: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """:meth:`MeshShape.nearest` of the shape with a handle, for graphs."""
    return shape_of(handle, MeshShape).nearest(x)


@nearest_in_graph.register_fake
def _(x: Tensor, *, handle: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    index = x.new_empty(len(x), dtype=torch.int64)
    return index, torch.empty_like(index), x.new_empty(len(x)), torch.empty_like(x)
