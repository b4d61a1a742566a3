"""Volume meshes: make, load, voxelise, tetrahedralise, save, measure."""

from diffsim.mesh.box import hex_box, tet_box
from diffsim.mesh.core import HexMesh, Mesh, TetMesh
from diffsim.mesh.reference import HEX_FROM_VTK, VTK_FROM_HEX
from diffsim.mesh.repair import (
    flip_inverted,
    merge_duplicate_nodes,
    remove_degenerate,
    remove_unreferenced_nodes,
    repair,
)
from diffsim.mesh.shape import ShapeGradients, nodal_volume, shape_gradients

__all__ = [
    "HEX_FROM_VTK",
    "VTK_FROM_HEX",
    "HexMesh",
    "Mesh",
    "ShapeGradients",
    "TetMesh",
    "flip_inverted",
    "hex_box",
    "merge_duplicate_nodes",
    "nodal_volume",
    "remove_degenerate",
    "remove_unreferenced_nodes",
    "repair",
    "shape_gradients",
    "tet_box",
]
