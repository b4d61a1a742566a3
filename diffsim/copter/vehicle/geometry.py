"""Closed triangle meshes whose vertices are linear in a part's parameters (thesis 3.2.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diffsim.core.arrays import Array, IntArray

SEGMENTS = 32  # around a circle; a multiple of 8, so that a square loop has its corners
UP = np.array([0.0, 0.0, -1.0])  # north-east-down


@dataclass(frozen=True, eq=False)
class LinearPoints:
    """Points that are linear in parameters: offset + basis @ parameters."""

    offset: Array  # points at parameters of zero, (..., 3) [m]
    basis: Array  # slopes by the parameters, (..., 3, num_parameters) [m per unit of the parameter]

    def at(self, parameters: Array) -> Array:
        """The points, (..., 3) [m]."""
        return self.offset + self.basis @ parameters


@dataclass(frozen=True, eq=False)
class LinearMesh:
    """A triangle mesh of linear vertices."""

    vertices: LinearPoints  # vertices, (num_vertices, 3) [m]
    faces: IntArray  # (num_faces, 3), oriented outwards


def fixed_points(points: Sequence[float] | Array, num_parameters: int = 0) -> LinearPoints:
    """Points that no parameter moves, (..., 3) [m]."""
    points = np.asarray(points, dtype=np.float64)
    return LinearPoints(points, np.zeros((*points.shape, num_parameters)))


def scaled_points(points: Array, axes: Sequence[int | None]) -> LinearPoints:
    """Points of a unit shape: coordinate i of parameter j = axes.index(i) is scaled by it.

    Args:
        points: (..., 3); coordinates along scaled axes are per meter of the parameter.
        axes: Per parameter the axis that it scales, or None for a parameter without effect.
    """
    points = np.asarray(points, dtype=np.float64)
    basis = np.zeros((*points.shape, len(axes)))
    offset = points.copy()
    for parameter, axis in enumerate(axes):
        if axis is not None:
            basis[..., axis, parameter] = points[..., axis]
            offset[..., axis] = 0.0
    return LinearPoints(offset, basis)


def circle_loop(radius: float, segments: int = SEGMENTS) -> Array:
    """Corners of a regular polygon with the area of the circle, counterclockwise, (segments, 2).

    Equal area, so that tubes and discs weigh what their formulas say.
    """
    step = 2.0 * np.pi / segments
    angles = step * np.arange(segments)
    corner = radius * np.sqrt(step / np.sin(step))
    return corner * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def square_loop(half: float, segments: int = SEGMENTS) -> Array:
    """A square with as many points as ``circle_loop``, at the same angles, (segments, 2)."""
    angles = 2.0 * np.pi / segments * np.arange(segments)
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return half * points / np.abs(points).max(axis=1, keepdims=True)


def ring_prism(outer: Array, inner: Array) -> tuple[Array, IntArray]:
    """A tube of unit length along x with any cross-section, hollow from end to end.

    Args:
        outer, inner: Loops in the y-z plane with equally many points, counterclockwise, (n, 2).

    Returns:
        Vertices (4n, 3), x from -0.5 to 0.5, and faces.
    """
    n = len(outer)
    loops = [(-0.5, outer), (0.5, outer), (0.5, inner), (-0.5, inner)]
    vertices = np.concatenate([np.column_stack([np.full(n, x), loop]) for x, loop in loops])
    quads = [_band(k * n, (k + 1) % 4 * n, n) for k in range(4)]
    return vertices, np.concatenate(quads)


def fan_prism(outline: Array, height: float) -> tuple[Array, IntArray]:
    """A plate of any outline that its center sees whole (star-shaped), z from -h/2 to h/2.

    Args:
        outline: Counterclockwise seen against z, around (0, 0), (n, 2).
        height: Height [m].

    Raises:
        ValueError: a side of the outline is not counterclockwise as seen from (0, 0).
    """
    following = np.roll(outline, -1, axis=0)
    turns = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
    if (turns <= 0.0).any():
        raise ValueError(
            "outline must be counterclockwise and star-shaped about (0, 0), got side "
            f"{int(turns.argmin())} from {outline[turns.argmin()].tolist()} that is not; move the "
            "outline or leave out the points that hide behind others"
        )
    n = len(outline)
    levels = [np.column_stack([outline, np.full(n, z)]) for z in (-0.5 * height, 0.5 * height)]
    centers = np.array([[0.0, 0.0, -0.5 * height], [0.0, 0.0, 0.5 * height]])
    here = np.arange(n)
    there = np.roll(here, -1)
    bottom = np.column_stack([np.full(n, 2 * n), there, here])
    top = np.column_stack([np.full(n, 2 * n + 1), n + here, n + there])
    sides = _band(0, n, n)
    return np.concatenate([*levels, centers]), np.concatenate([bottom, top, sides])


def _band(first: int, second: int, n: int) -> IntArray:
    """Triangles between two loops of n points that start at these indices."""
    here = np.arange(n)
    there = np.roll(here, -1)
    a, b = first + here, first + there
    c, d = second + here, second + there
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([b, d, c])])


def box(size: Sequence[float]) -> tuple[Array, IntArray]:
    """A cuboid around the origin, size (3,) [m]."""
    corners = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    vertices, faces = fan_prism(corners, 1.0)
    return vertices * np.asarray(size, dtype=np.float64), faces


def rotation_rpy(degrees: Sequence[float]) -> Array:
    """R = Rz(yaw) Ry(pitch) Rx(roll), angles (roll, pitch, yaw) [deg], (3, 3)."""
    result = np.eye(3)
    for axis, angle in enumerate(degrees):
        result = rotation_about(np.eye(3)[axis], angle) @ result
    return result


def rotation_about(axis: Array, degrees: float) -> Array:
    """Right-handed turn about a unit axis (3,) [deg], (3, 3); quarter turns are exact."""
    quarter = degrees / 90.0
    if quarter == round(quarter):
        sin, cos = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))[int(quarter) % 4]
    else:
        sin, cos = float(np.sin(np.deg2rad(degrees))), float(np.cos(np.deg2rad(degrees)))
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) * cos + sin * cross + (1.0 - cos) * np.outer(axis, axis)


def frame_of(axis: Array, reference: Array) -> Array:
    """Orthonormal columns (axis, reference made perpendicular, their cross product), (3, 3)."""
    axis = axis / np.linalg.norm(axis)
    side = reference - axis * (reference @ axis)
    side = side / np.linalg.norm(side)
    return np.column_stack([axis, side, np.cross(axis, side)])
