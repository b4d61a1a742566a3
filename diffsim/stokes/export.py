"""What leaves the simulation: solids to fabricate (.stl) and fields to look at (.vti, .vtu).

Rerun scenes (.rrd) are in ``diffsim.viz.flow_scene``, pictures in ``diffsim.viz.flow``.
"""

from diffsim.stokes.fabrication import channel_mesh, fabrication_mesh, wall_mesh
from diffsim.stokes.printing import FabricationReport, fabrication_report, write_stl
from diffsim.stokes.vtk import write_vtk

__all__ = [
    "FabricationReport",
    "channel_mesh",
    "fabrication_mesh",
    "fabrication_report",
    "wall_mesh",
    "write_stl",
    "write_vtk",
]
