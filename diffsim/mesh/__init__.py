"""Volume meshes: make, load, voxelize, tetrahedralize, save, measure."""

from diffsim.mesh import sdf
from diffsim.mesh.box import hex_box, tet_box
from diffsim.mesh.cage import Blend, Cage, safe_share
from diffsim.mesh.cavities import cavities
from diffsim.mesh.core import HexMesh, Mesh, TetMesh
from diffsim.mesh.distance import SurfaceDistance
from diffsim.mesh.files import load, load_arrays, load_surface, save
from diffsim.mesh.from_surface import tetrahedralize, voxelize
from diffsim.mesh.measure import Quality, element_size, element_volumes, quality, total_volume
from diffsim.mesh.reference import HEX_FROM_VTK, VTK_FROM_HEX
from diffsim.mesh.regions import RegionMesh, load_regions
from diffsim.mesh.repair import (
    flip_inverted,
    merge_duplicate_nodes,
    remove_degenerate,
    remove_unreferenced_nodes,
    repair,
)
from diffsim.mesh.shape import ShapeGradients, nodal_shares, nodal_volume, shape_gradients
from diffsim.mesh.solids import (
    hex_cylinder,
    hex_sphere,
    hex_torus,
    tet_cylinder,
    tet_sphere,
    tet_torus,
)
from diffsim.mesh.split import split_positions, split_tets
from diffsim.mesh.stuffing import tet_from_sdf
from diffsim.mesh.surface import (
    Surface,
    surface_quads,
    surface_triangles,
    surface_vertices,
    to_trimesh,
)
from diffsim.mesh.voxels import hex_from_sdf

__all__ = [
    "HEX_FROM_VTK",
    "VTK_FROM_HEX",
    "Blend",
    "Cage",
    "HexMesh",
    "Mesh",
    "Quality",
    "RegionMesh",
    "ShapeGradients",
    "Surface",
    "SurfaceDistance",
    "TetMesh",
    "cavities",
    "element_size",
    "element_volumes",
    "flip_inverted",
    "hex_box",
    "hex_cylinder",
    "hex_from_sdf",
    "hex_sphere",
    "hex_torus",
    "load",
    "load_arrays",
    "load_regions",
    "load_surface",
    "merge_duplicate_nodes",
    "nodal_shares",
    "nodal_volume",
    "quality",
    "remove_degenerate",
    "remove_unreferenced_nodes",
    "repair",
    "safe_share",
    "save",
    "sdf",
    "shape_gradients",
    "split_positions",
    "split_tets",
    "surface_quads",
    "surface_triangles",
    "surface_vertices",
    "tet_box",
    "tet_cylinder",
    "tet_from_sdf",
    "tet_sphere",
    "tet_torus",
    "tetrahedralize",
    "to_trimesh",
    "total_volume",
    "voxelize",
]
