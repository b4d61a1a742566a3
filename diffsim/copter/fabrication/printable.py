"""What is printed, part by part: meshes in millimeters as they stand on the bed, z up.

Meshes differ from the design's in what printing and screws need: bores are wider by a clearance,
posts, clips and frames have screw holes. The print's volume is therefore a little smaller.

Clips and frames are plates with holes, the top level or tilted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import Delaunay

from diffsim.copter.design.design import Design
from diffsim.copter.design.placement import PlacedPart
from diffsim.core.arrays import Array, IntArray, Mask
from diffsim.core.checked import checked
from diffsim.core.errors import MeshError

if TYPE_CHECKING:
    import trimesh


MM = 1e3
CLEARANCE = 0.15  # of a bore around its rod, in radius [mm]
SCREW_HOLE = 1.7  # M3, passes freely; radius [mm]
PILOT_HOLE = 1.25  # M3, cuts its own thread; radius [mm]
SHAFT_HOLE = 3.5  # room for the end of the motor's shaft; radius [mm]
BOLT_CIRCLE = 9.5  # of the motor's four screws; radius [mm]
NOTCH = 1.5  # depth of the mark on a clip's rim [mm]
_RIM = 2.0  # least material between a screw hole and the rim [mm]
_BED_FROM_PART = np.diag([1.0, -1.0, -1.0])  # parts are NED, up is -z


def print_mesh(placed: PlacedPart, values: Array, design: Design) -> trimesh.Trimesh:
    """The mesh of a printed part, centered on the bed, z from 0 up [mm].

    Args:
        values: Shape parameters of the part [m].
        design: The design, which says what is screwed onto a frame.
    """
    import trimesh

    maker = _MAKERS.get(placed.part.kind)
    if maker is not None:
        return maker(placed, values, design)
    vertices = MM * placed.part.mesh.vertices.at(values) @ _BED_FROM_PART
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    vertices = vertices - [middle[0], middle[1], vertices[:, 2].min()]
    return trimesh.Trimesh(vertices, placed.part.mesh.faces, process=False)


def connector_mesh(rod_diameter: float, side: float, length: float) -> trimesh.Trimesh:
    """A block with an upright bore for a rod; all lengths [mm]."""
    half = 0.5 * side
    outline = refined(np.array([[half, half], [-half, half], [-half, -half], [half, -half]]), 4.0)
    return perforated_prism(outline, [circle(0.5 * rod_diameter + CLEARANCE)], length)


@checked
def clip_mesh(
    along: float, across: float, middle: float = 8.0, radius: float = 18.0
) -> trimesh.Trimesh:
    """A compound-angle clip (thesis 3.6): a wedge between a flat base and a motor.

    The four screw holes run square to the tilted top. They are left out where they would leave
    through the rim (``has_screw_holes``). A notch in the rim marks the clip's x axis.

    Args:
        along: Tilt of the top's normal towards the notch, x [deg].
        across: Tilt of the top's normal to the right of it seen from above, -y as printed [deg].
        middle: Thickness in the middle [mm].
        radius: Radius [mm].
    """
    lean = _lean(along, across)
    outline = circle(radius, segments=72)
    outline[0, 0] -= NOTCH
    centers, slope = _bolts() if has_screw_holes(along, across, middle, radius) else [], -lean
    holes = [circle(SHAFT_HOLE)] + [circle(SCREW_HOLE, c) for c in centers]
    below = [h - (middle + h @ slope)[:, None] * lean for h in holes]
    below[0] = holes[0]  # the shaft's room is upright
    return perforated_prism(outline, holes, middle, slope, below)


def has_screw_holes(along: float, across: float, middle: float, radius: float = 18.0) -> bool:
    """Whether screws pass through a clip, or the motor is glued (arguments: ``clip_mesh``)."""
    lean = _lean(along, across)
    bolts = np.array(_bolts())
    out = bolts - lean * (middle - bolts @ lean)[:, None]
    return bool(np.linalg.norm(out, axis=1).max() + SCREW_HOLE + _RIM <= radius)


def clip_angles(placed: PlacedPart) -> tuple[float, float]:
    """``along`` and ``across`` of a clip in a design [deg]."""
    x, y, z = placed.part.patches["top"].axis
    return float(np.rad2deg(np.arctan2(x, -z))), float(np.rad2deg(np.arctan2(y, -z)))


def clip_middle(placed: PlacedPart) -> float:
    """Thickness of a clip in the middle [mm]."""
    return -MM * float(placed.part.patches["top"].center.offset[2])


def post_mesh(diameter: float, height: float) -> trimesh.Trimesh:
    """A round post with a pilot hole from end to end; lengths [mm]."""
    return perforated_prism(circle(0.5 * diameter), [circle(PILOT_HOLE, segments=24)], height)


def _bolts() -> list[Array]:
    angles = np.deg2rad([45.0, 135.0, 225.0, 315.0])
    return list(BOLT_CIRCLE * np.column_stack([np.cos(angles), np.sin(angles)]))


def _lean(along: float, across: float) -> Array:
    """Sideways part of the top's normal per unit of height, as printed."""
    return np.tan(np.deg2rad([along, -across]))


def _connector(placed: PlacedPart, values: Array, design: Design) -> trimesh.Trimesh:
    length, side, _ = MM * np.ptp(placed.part.mesh.vertices.at(values), axis=0)
    return connector_mesh(MM * float(str(placed.part.options["rod_diameter"])), side, length)


def _clip(placed: PlacedPart, values: Array, design: Design) -> trimesh.Trimesh:
    return clip_mesh(*clip_angles(placed), clip_middle(placed))


def _post(placed: PlacedPart, values: Array, design: Design) -> trimesh.Trimesh:
    return post_mesh(MM * float(str(placed.part.options["diameter"])), MM * float(values[0]))


def _frame(placed: PlacedPart, values: Array, design: Design) -> trimesh.Trimesh:
    vertices = MM * placed.part.mesh.vertices.at(values) @ _BED_FROM_PART
    n = (len(vertices) - 2) // 2  # two copies of the outline, and their middles
    kinds = {p.name: p.part.kind for p in design.parts}
    holes = []
    for connection in design.spec.connections:
        host, _, patch = connection.host.partition(".")
        guest = kinds[connection.guest.partition(".")[0]]
        if host != placed.name or guest not in ("motor", "standoff", "screw_mount"):
            continue
        x, y, _ = MM * placed.part.patches[patch].center.at(values) @ _BED_FROM_PART
        if guest == "motor":
            holes += [circle(SHAFT_HOLE, (x, y), 24)]
            holes += [circle(SCREW_HOLE, (x + dx, y + dy), 24) for dx, dy in _bolts()]
        else:
            holes.append(circle(SCREW_HOLE, (x, y), 24))
    thickness = float(np.ptp(vertices[:, 2]))
    mesh = perforated_prism(refined(vertices[:n, :2], 3.0), holes, thickness)
    lower, upper = mesh.bounds
    mesh.apply_translation([*(-0.5 * (lower + upper)[:2]), 0.0])
    return mesh


_MAKERS: dict[str, Callable[[PlacedPart, Array, Design], trimesh.Trimesh]] = {
    "round_connector": _connector,
    "compound_angle_clip": _clip,
    "screw_mount": _post,
    "standoff": _post,
    "x_frame": _frame,
    "outline_frame": _frame,
}


_FLAT = 1e-9  # height over length of triangles between three points of one straight side: rounding


def circle(
    radius: float, center: Sequence[float] | Array = (0.0, 0.0), segments: int = 48
) -> Array:
    """Corners of a regular polygon inside the circle, counterclockwise, (segments, 2)."""
    angles = 2.0 * np.pi / segments * np.arange(segments)
    return np.asarray(center) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def refined(loop: Array, spacing: float) -> Array:
    """A closed loop with extra points, so that no side is longer than ``spacing``."""
    pieces = []
    for a, b in zip(loop, np.roll(loop, -1, axis=0), strict=True):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / spacing)))
        pieces.append(a + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * (b - a))
    return np.concatenate(pieces)


def perforated_prism(
    outline: Array,
    holes: Sequence[Array],
    height: float,
    slope: Sequence[float] | Array = (0.0, 0.0),
    holes_below: Sequence[Array] | None = None,
) -> trimesh.Trimesh:
    """A plate on z = 0 with holes from end to end, its top z = height + slope . (x, y).

    Args:
        outline: Closed loop without crossings, either sense, (n, 2).
        holes: Loops inside it that keep clear of each other, each (m, 2).
        height: Height of the top at the origin, in the unit of the outline.
        slope: Rise of the top per length along x and y.
        holes_below: The same loops at z = 0, for holes that are not upright.

    Returns:
        A closed surface, oriented outwards.

    Raises:
        MeshError: holes leave the outline, meet, or have sides too long for their distance.
    """
    import trimesh

    outline = outline if _area(outline) > 0.0 else outline[::-1]
    flip = [h if _area(h) < 0.0 else h[::-1] for h in holes]
    below = holes if holes_below is None else holes_below
    upper = [outline, *flip]
    lower = [outline, *(h if _area(h) < 0.0 else h[::-1] for h in below)]
    flat, ground = np.concatenate(upper), np.concatenate(lower)
    n = len(flat)
    top = np.column_stack([flat, height + flat @ np.asarray(slope)])
    bottom = np.column_stack([ground, np.zeros(n)])
    i, j = _sides(upper).T
    walls = [np.column_stack([i, j, n + j]), np.column_stack([i, n + j, n + i])]
    faces = [_triangulate(lower)[:, ::-1], n + _triangulate(upper), *walls]
    return trimesh.Trimesh(np.concatenate([bottom, top]), np.concatenate(faces), process=False)


def inside(points: Array, loops: Sequence[Array]) -> Mask:
    """Whether points lie within an odd number of closed loops, (num_points,)."""
    x, y = points[:, :1], points[:, 1:]
    crossings = np.zeros(len(points), dtype=int)
    for loop in loops:
        a, b = loop, np.roll(loop, -1, axis=0)
        spans = (a[:, 1] <= y) != (b[:, 1] <= y)
        rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
        at = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0])
        crossings += (spans & (at > x)).sum(axis=1)
    return crossings % 2 == 1


def _triangulate(loops: Sequence[Array]) -> IntArray:
    """Delaunay triangles between the loops, counterclockwise; their border must be the loops."""
    flat = np.concatenate(loops)
    triangles = Delaunay(flat).simplices.astype(np.int64)
    triangles = triangles[inside(flat[triangles].mean(axis=1), loops)]
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    triangles[turn < 0.0] = triangles[turn < 0.0][:, ::-1]
    lengths = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    triangles = triangles[np.abs(turn) > _FLAT * lengths**2]
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    directed = {tuple(e) for e in edges.tolist()}
    border = {e for e in directed if e[::-1] not in directed}
    wanted = {tuple(e) for e in _sides(loops).tolist()}
    if border != wanted:
        raise MeshError(
            f"{len(wanted - border)} sides of the outline or its holes are crossed by triangles; "
            "refine the loops or move holes away from each other and from the outline",
            tuple(sorted({i for side in wanted - border for i in side})),
        )
    return triangles


def _sides(loops: Sequence[Array]) -> IntArray:
    """Point pairs along all loops, (num_points, 2)."""
    pairs, start = [], 0
    for loop in loops:
        here = start + np.arange(len(loop))
        pairs.append(np.column_stack([here, np.roll(here, -1)]))
        start += len(loop)
    return np.concatenate(pairs)


def _area(loop: Array) -> float:
    x, y = loop.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
