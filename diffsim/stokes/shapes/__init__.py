"""Level sets of fluid domains, differentiable in their parameters and in the points.

phi > 0 in the FLUID, phi < 0 in the solid, everywhere in this package (the thesis, 4.2.5, has it
the other way round). Signed distances of ``diffsim.mesh.sdf``, negative inside a solid, fit as they
are.
"""

from diffsim.stokes.shapes.base import (
    Complement,
    Custom,
    Intersection,
    LevelSet,
    Shape,
    Union,
)
from diffsim.stokes.shapes.bezier import BezierCurve2d
from diffsim.stokes.shapes.nurbs import BSplineSurface, NurbsSurface
from diffsim.stokes.shapes.primitives import Box, Plane, Sphere
from diffsim.stokes.shapes.sampling import grid_nodes, interface, sample
from diffsim.stokes.shapes.smooth import SmoothIntersection, SmoothUnion
from diffsim.stokes.shapes.spline_basis import SplineBasis
from diffsim.stokes.shapes.transform import Extrude, Rotate, Translate

__all__ = [
    "BSplineSurface",
    "BezierCurve2d",
    "Box",
    "Complement",
    "Custom",
    "Extrude",
    "Intersection",
    "LevelSet",
    "NurbsSurface",
    "Plane",
    "Rotate",
    "Shape",
    "SmoothIntersection",
    "SmoothUnion",
    "Sphere",
    "SplineBasis",
    "Translate",
    "Union",
    "grid_nodes",
    "interface",
    "sample",
]
