"""Whether a mesh can be printed: closed, thick enough, small enough for the bed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.check import require_number
from diffsim.core.checked import checked

if TYPE_CHECKING:
    import trimesh

_OPPOSITE = 0.5  # cosine: two faces make a wall if their normals oppose within 60 degrees
_RAYS = 64  # at a time: more leave the processor's cache


@checked
@dataclass(frozen=True, kw_only=True)
class Printer:
    """What a printer can do.

    Attributes:
        bed: Greatest size along x, y and z, (3,) [mm].
        min_wall: Thinnest wall, three lines of a 0.4 mm nozzle by default [mm].
    """

    bed: tuple[float, float, float] = (220.0, 220.0, 250.0)
    min_wall: float = 1.2

    def __post_init__(self) -> None:
        if len(self.bed) != 3:
            raise ValueError(f"bed must be 3 lengths [mm], got {list(self.bed)}")
        for axis, length in zip("xyz", self.bed, strict=True):
            require_number(f"bed along {axis}", length, above=0.0)
        require_number("min_wall", self.min_wall, above=0.0)


@checked(kinds_only=True)
@dataclass(frozen=True)
class PrintCheck:
    """The outcome of a check.

    Attributes:
        watertight: Closed, every side shared by two triangles.
        volume: [mm^3]; negative where the surface is inside out.
        wall: Thinnest wall met [mm], infinity if no two faces oppose each other.
        size: Along x, y and z as it lies on the bed, (3,) [mm].
        problems: One sentence each; empty if it can be printed.
    """

    watertight: bool
    volume: float
    wall: float
    size: tuple[float, float, float]
    problems: tuple[str, ...]


def check_print(mesh: trimesh.Trimesh, printer: Printer) -> PrintCheck:
    """Check a mesh in millimeters, standing on the bed as it is to be printed."""
    watertight = bool(mesh.is_watertight and mesh.is_winding_consistent)
    volume = float(mesh.volume)
    x, y, z = (float(v) for v in mesh.extents)
    wall = thinnest_wall(mesh)
    problems = []
    if not watertight:
        problems.append("the surface is not closed")
    if not volume > 0.0:
        problems.append(f"the surface is inside out (volume {volume:.3g} mm^3)")
    if wall < printer.min_wall:
        problems.append(f"a wall of {wall:.2g} mm is thinner than {printer.min_wall:g} mm")
    long, short = max(printer.bed[:2]), min(printer.bed[:2])
    if max(x, y) > long or min(x, y) > short or z > printer.bed[2]:
        bed = " x ".join(f"{v:g}" for v in printer.bed)
        problems.append(f"{x:.0f} x {y:.0f} x {z:.0f} mm do not fit the bed of {bed} mm")
    return PrintCheck(watertight, volume, wall, (x, y, z), tuple(problems))


def thinnest_wall(mesh: trimesh.Trimesh) -> float:
    """Least distance from the middle of a triangle straight through to an opposite face.

    Faces that meet at an edge are no wall: the normals must oppose within 60 degrees.
    """
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    starts, normals = mesh.triangles_center, mesh.face_normals
    ends = [
        _first_hits(starts[some], -normals[some], a, b - a, c - a, normals)
        for some in (slice(k, k + _RAYS) for k in range(0, len(normals), _RAYS))
    ]
    return float(np.concatenate(ends).min()) if ends else np.inf


def _first_hits(starts: Array, rays: Array, a: Array, e1: Array, e2: Array, faces: Array) -> Array:
    """Distance along each ray to the first triangle that faces away (Moeller and Trumbore 1997)."""
    ray, face = np.nonzero(rays @ faces.T > _OPPOSITE)
    a, e1, e2, along = a[face], e1[face], e2[face], rays[ray]
    p = np.cross(along, e2)
    det = np.einsum("fi,fi->f", e1, p)
    det = np.where(np.abs(det) < 1e-300, np.inf, det)
    offset = starts[ray] - a
    u = np.einsum("fi,fi->f", offset, p) / det
    q = np.cross(offset, e1)
    v = np.einsum("fi,fi->f", q, along) / det
    t = np.einsum("fi,fi->f", e2, q) / det
    hit = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9) & (t > 1e-9)
    first = np.full(len(rays), np.inf)
    np.minimum.at(first, ray[hit], t[hit])
    return first
