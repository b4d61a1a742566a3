"""Rerun recordings (``.rrd``) of Stokes flows: wall, streamlines and arrows colored by speed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array
from diffsim.core.check import require_number
from diffsim.stokes.fabrication import wall_mesh
from diffsim.stokes.field import FlowField
from diffsim.stokes.streamlines import Streamline, streamlines
from diffsim.viz.flow import SPEED
from diffsim.viz.scene import write_recording


def write_rerun(
    path: str | Path,
    field: FlowField,
    *,
    title: str = "flow",
    case: int = 0,
    lines: int | Sequence[Streamline] = 80,
    num_arrows: int = 1500,
    height: float | None = None,
) -> Path:
    """Write one flow as a scene, in place of an older file only when it is whole.

    Entities: "wall" (translucent), "box", "streamlines", "arrows" (velocity at cell centers in the
    fluid, the longest two cells long) and, moving along the lines in flow time, "tracers".

    Args:
        path: File name with the extension .rrd; folders are made.
        field: The flow; one in 2D lies in z = 0 with its wall extruded.
        case: Index of the inlet case.
        lines: Streamlines, or how many to start where fluid enters.
        num_arrows: Approximate number of arrows.
        height: Height of the wall of a 2D flow [m]; default a tenth of the longest side.

    Raises:
        ImportError: rerun-sdk is not installed.
    """
    path = Path(path)
    if not isinstance(field, FlowField):
        raise TypeError(f"field must be a FlowField, got {type(field).__name__}")
    if path.suffix.lower() != ".rrd":
        raise ValueError(f"path must end in .rrd, got {path.name!r}")
    grid = field.grid
    if grid.dim == 2:
        height = 0.1 * max(grid.size) if height is None else height
        require_number("height", height, above=0.0)
    elif height is not None:
        raise ValueError("height is for 2D flows; this grid has three axes")
    if isinstance(lines, int):
        lines = streamlines(field, lines, case=case) if lines else []
    return write_recording(
        path, title, lambda rr, stream: _log(rr, stream, field, case, lines, num_arrows, height)
    )


def _log(
    rr: Any,
    stream: Any,
    field: FlowField,
    case: int,
    lines: Sequence[Streamline],
    num_arrows: int,
    height: float | None,
) -> None:
    grid = field.grid
    cell = min(grid.spacing)
    wall = wall_mesh(grid, field.phi, height=height)
    if len(wall.faces):
        mesh = rr.Mesh3D(
            vertex_positions=wall.vertices,
            triangle_indices=wall.faces,
            vertex_normals=wall.vertex_normals,
            albedo_factor=[150, 158, 170, 90],
        )
        stream.log("wall", mesh, static=True)
    half = 0.5 * np.array([*grid.size, *[height] * (3 - grid.dim)], dtype=float)
    middle = np.array([*grid.origin, *[0.0] * (3 - grid.dim)]) + half
    box = rr.Boxes3D(centers=[middle], half_sizes=[half], colors=[[140, 148, 160]])
    stream.log("box", box, static=True)
    # a 2D flow lies in the middle of its extruded wall
    lift = 0.5 * height if height is not None else 0.0
    fluid = field.phi.detach().numpy() > 0.0
    speeds = field.velocity[case].detach().norm(dim=-1).numpy()
    top = float(speeds[fluid].max(initial=0.0))
    pieces, colors = [], []
    for line in lines:
        points = _lift_to_space(line.points, lift)
        for k in range(0, len(points) - 1, 2):  # a strip has one color: short strips
            pieces.append(points[k : k + 3])
            colors.append(_color_by_speed(line.speed[k : k + 3].mean(keepdims=True), top)[0])
    if pieces:
        strips = rr.LineStrips3D(pieces, colors=np.array(colors), radii=[0.06 * cell])
        stream.log("streamlines", strips, static=True)
        _tracers(rr, stream, [line for line in lines if len(line.points) > 1], lift, cell)
    at, v = _arrows(field, case, num_arrows)
    if len(at) and top > 0.0:
        arrows = rr.Arrows3D(
            origins=_lift_to_space(at, lift),
            vectors=_lift_to_space(v, 0.0) * (2.0 * cell / top),
            colors=_color_by_speed(np.linalg.norm(v, axis=-1), top),
            radii=[0.04 * cell],
        )
        stream.log("arrows", arrows, static=True)


def _tracers(rr: Any, stream: Any, lines: Sequence[Streamline], lift: float, cell: float) -> None:
    """Points that ride along the lines, over the time in which most of them pass."""
    end = float(np.median([line.time[-1] for line in lines]))
    for t in np.linspace(0.0, end, 61):
        at = [
            [np.interp(t, line.time, x) for x in line.points.T]
            for line in lines
            if t <= line.time[-1]
        ]
        stream.set_time("flow_time", duration=float(t))
        points = rr.Points3D(
            _lift_to_space(np.array(at), lift), colors=[[194, 87, 26]], radii=[0.2 * cell]
        )
        stream.log("tracers", points)


def _arrows(field: FlowField, case: int, count: int) -> tuple[Array, Array]:
    """Centers of cells in the fluid, every so many, and the velocity there."""
    grid = field.grid
    full = field.volume_fraction.detach() > 0.999
    step = max(1, round((int(full.sum()) / max(count, 1)) ** (1.0 / grid.dim)))
    chosen = np.zeros(grid.shape, dtype=bool)
    chosen[tuple(slice(step // 2, None, step) for _ in grid.shape)] = count > 0
    at = grid.centers[full.numpy() & chosen]
    return at.numpy(), field.sample(at)[case].detach().numpy()


def _lift_to_space(points: Array, lift: float) -> Array:
    """Points or vectors in space: (n, 2) get a third component."""
    if points.shape[-1] == 3:
        return points
    return np.concatenate([points, np.full((len(points), 1), lift)], axis=-1)


def _color_by_speed(speed: Array, top: float) -> NDArray[np.uint8]:
    """Colors of speeds, (n, 3)."""
    table = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in SPEED])
    share = np.clip(speed / top if top > 0.0 else 0.0 * speed, 0.0, 1.0) * (len(table) - 1)
    columns = [np.interp(share, np.arange(len(table)), table[:, k]) for k in range(3)]
    return np.stack(columns, axis=-1).astype(np.uint8)
