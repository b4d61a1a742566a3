"""Round solids: hexahedra that follow the surface (O-grids), tetrahedra by lattice stuffing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from diffsim.core.arrays import Array, IntArray
from diffsim.core.check import require_number, require_numbers
from diffsim.core.checked import checked
from diffsim.mesh import sdf
from diffsim.mesh.box import box_arrays
from diffsim.mesh.core import HexMesh, TetMesh
from diffsim.mesh.reference import HEX_FACES
from diffsim.mesh.stuffing import tet_from_sdf
from diffsim.mesh.surface import boundary_faces

Center = Sequence[float]

_CORE = 0.6
"""Half width of the square core of an O-grid over the radius."""
MAX_CELLS = 1000
"""Along a radius: more would not fit into any memory."""
_ROUND = 0.6
"""How round the core is: 0 a cube, 1 a ball."""


@checked
def hex_sphere(radius: float, spacing: float, center: Center = (0.0, 0.0, 0.0)) -> HexMesh:
    """A ball: a rounded cube of hexahedra within layers that end on the sphere.

    Nodes of the surface lie on the sphere, so volume converges with the second order.

    Args:
        radius: Radius [m].
        spacing: Target edge length at the surface [m].
        center: Center of the solid, (3,) [m].
    """
    radius, num, layers = _resolution("radius", radius, spacing)
    x, hexes = box_arrays((num,) * 3, (2.0,) * 3, (-1.0,) * 3)
    core, on_sphere = _core(x)
    quads = boundary_faces(hexes, HEX_FACES)[0]
    skin, local = np.unique(quads, return_inverse=True)
    local = local.reshape(quads.shape)
    levels = [skin] + [len(x) + level * len(skin) + np.arange(len(skin)) for level in range(layers)]
    parts, elements = [core], [hexes]
    for level in range(layers):
        t = (level + 1) / layers
        parts.append((1.0 - t) * core[skin] + t * on_sphere[skin])
        inner, outer = levels[level][local], levels[level + 1][local]
        # i outwards: (dj, dk) = 00, 01, 10, 11 are corners a, d, b, c of the quad
        elements.append(np.concatenate([inner[:, [0, 3, 1, 2]], outer[:, [0, 3, 1, 2]]], axis=1))
    return _hex(np.concatenate(parts) * radius, np.concatenate(elements), center)


@checked
def hex_cylinder(
    radius: float, height: float, spacing: float, center: Center = (0.0, 0.0, 0.0)
) -> HexMesh:
    """A cylinder along z with nodes on its mantle; ``height`` is the full height [m]."""
    radius, num, layers = _resolution("radius", radius, spacing)
    height = require_number("height", height, above=0.0)
    uv, quads = _disc(num, layers)
    count = max(1, round(height / spacing))
    z = np.linspace(-0.5 * height, 0.5 * height, count + 1)
    x = np.empty((count + 1, len(uv), 3))
    x[..., :2] = uv * radius
    x[..., 2] = z[:, None]
    return _hex(x.reshape(-1, 3), _sweep(quads, len(uv), count, closed=False), center)


@checked
def hex_torus(
    major_radius: float, minor_radius: float, spacing: float, center: Center = (0.0, 0.0, 0.0)
) -> HexMesh:
    """A ring around the z axis with nodes on its surface.

    Args:
        major_radius: Radius of the tube's axis [m], larger than ``minor_radius``.
        minor_radius: Radius of the tube [m].
        spacing: Target edge length at the surface and along the tube's axis [m].
        center: Center of the solid, (3,) [m].
    """
    minor, num, layers = _resolution("minor_radius", minor_radius, spacing)
    major = require_number("major_radius", major_radius, above=minor)
    uv, quads = _disc(num, layers)
    count = max(8, round(2.0 * math.pi * major / spacing))
    phi = -2.0 * math.pi * np.arange(count) / count  # (radial, z, -phi) is right-handed
    distance = major + minor * uv[:, 0]
    x = np.empty((count, len(uv), 3))
    x[..., 0] = np.cos(phi)[:, None] * distance
    x[..., 1] = np.sin(phi)[:, None] * distance
    x[..., 2] = minor * uv[:, 1]
    return _hex(x.reshape(-1, 3), _sweep(quads, len(uv), count, closed=True), center)


@checked
def tet_sphere(radius: float, spacing: float, center: Center = (0.0, 0.0, 0.0)) -> TetMesh:
    """A ball of tetrahedra; nodes of the surface lie on the sphere (see `tet_from_sdf`)."""
    shape = sdf.sphere(radius, center)
    return tet_from_sdf(shape, _around(center, [radius] * 3), spacing)


@checked
def tet_cylinder(
    radius: float, height: float, spacing: float, center: Center = (0.0, 0.0, 0.0)
) -> TetMesh:
    """A cylinder along z of tetrahedra; its rims are cut by about half a spacing."""
    shape = sdf.cylinder(radius, height, center)
    return tet_from_sdf(shape, _around(center, [radius, radius, 0.5 * height]), spacing)


@checked
def tet_torus(
    major_radius: float, minor_radius: float, spacing: float, center: Center = (0.0, 0.0, 0.0)
) -> TetMesh:
    """A ring around the z axis of tetrahedra; nodes of the surface lie on the torus."""
    shape = sdf.torus(major_radius, minor_radius, center)
    reach = major_radius + minor_radius
    return tet_from_sdf(shape, _around(center, [reach, reach, minor_radius]), spacing)


def _around(center: Center, reach: Sequence[float]) -> tuple[list[float], list[float]]:
    low = [float(c) - r for c, r in zip(center, reach, strict=True)]
    return low, [float(c) + r for c, r in zip(center, reach, strict=True)]


def _resolution(name: str, radius: float, spacing: float) -> tuple[float, int, int]:
    """Radius, cells along a side of the core (a quarter of the circumference), layers."""
    radius = require_number(name, radius, above=0.0)
    spacing = require_number("spacing", spacing, above=0.0, at_most=radius, hint=f"at most {name}")
    require_number(name, radius, at_most=MAX_CELLS * spacing, hint="or a larger spacing")
    num = max(2, round(0.5 * math.pi * radius / spacing))
    return radius, num, max(1, round(0.35 * radius / spacing))


def _core(p: Array) -> tuple[Array, Array]:
    """Cube [-1, 1]^d to the rounded core of the unit ball, and its skin's place on the sphere."""
    reach = np.abs(p).max(axis=1, keepdims=True)
    safe = np.where(reach > 0, reach, 1.0)
    w = safe * np.tan(0.25 * math.pi * p / safe)  # equal angles on the sphere
    length = np.linalg.norm(w, axis=1, keepdims=True)
    unit = w / np.where(length > 0, length, 1.0)
    return _CORE * ((1.0 - _ROUND) * w + _ROUND * reach * unit), unit


def _disc(num: int, layers: int) -> tuple[Array, IntArray]:
    """O-grid of the unit disc: nodes (P, 2) and counter-clockwise quads (Q, 4)."""
    axis = np.linspace(-1.0, 1.0, num + 1)
    p = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    core, on_circle = _core(p)
    i, j = np.indices((num, num)).reshape(2, -1)
    a = i * (num + 1) + j
    quads = np.stack([a, a + num + 1, a + num + 2, a + 1], axis=1)
    up = np.arange(num)
    ring = np.concatenate(  # node indices around the core, counter-clockwise
        [up * (num + 1), num * (num + 1) + up, (num - up) * (num + 1) + num, num - up]
    )
    parts, elements, inner = [core], [quads], ring
    for level in range(layers):
        t = (level + 1) / layers
        outer = len(p) + level * len(ring) + np.arange(len(ring))
        parts.append((1.0 - t) * core[ring] + t * on_circle[ring])
        elements.append(np.stack([inner, outer, np.roll(outer, -1), np.roll(inner, -1)], axis=1))
        inner = outer
    return np.concatenate(parts), np.concatenate(elements).astype(np.int64)


def _sweep(quads: IntArray, num_nodes: int, count: int, closed: bool) -> IntArray:
    """Hexahedra between ``count`` (closed) or ``count + 1`` copies of a quad mesh, k along."""
    sections = np.arange(count)[:, None, None]
    after = (sections + 1) % count if closed else sections + 1
    bottom, top = quads + sections * num_nodes, quads + after * num_nodes
    columns = [part[..., c] for c in (0, 3, 1, 2) for part in (bottom, top)]
    return np.stack(columns, axis=-1).reshape(-1, 8)


def _hex(x: Array, hexes: IntArray, center: Center) -> HexMesh:
    middle = require_numbers("center", center, 3)
    return HexMesh(torch.from_numpy(x + np.array(middle)), torch.from_numpy(hexes))
