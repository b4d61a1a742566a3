"""Contact: obstacles as signed distance, detection, penalty forces, body against body."""

from diffsim.contact.balls import ball_force
from diffsim.contact.bodies import BodyContact
from diffsim.contact.clear import check_clear
from diffsim.contact.detect import ContactPlanes, detect
from diffsim.contact.height_field import HeightField
from diffsim.contact.mesh_shape import MeshShape
from diffsim.contact.obstacle import Obstacle, box, capsule, floor, plane, sphere
from diffsim.contact.penalty import penalty_force
from diffsim.contact.shapes import Box, Capsule, Custom, Plane, Shape, Sphere, Trough

__all__ = [
    "BodyContact",
    "Box",
    "Capsule",
    "ContactPlanes",
    "Custom",
    "HeightField",
    "MeshShape",
    "Obstacle",
    "Plane",
    "Shape",
    "Sphere",
    "Trough",
    "ball_force",
    "box",
    "capsule",
    "check_clear",
    "detect",
    "floor",
    "penalty_force",
    "plane",
    "sphere",
]
