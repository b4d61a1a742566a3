"""Rerun recordings (``.rrd``): moving surfaces, markers and curves on one clock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array, IntArray
from diffsim.core.files import write_bytes_atomic
from diffsim.core.optional import optional


@dataclass(frozen=True, kw_only=True)
class MovingSurface:
    """A triangulated surface over time."""

    path: str  # entity path, such as ``gravity/identified``
    time_s: Array  # times of the frames, (T,) [s]
    nodes_m: NDArray[np.float32]  # positions of the nodes, (T, N, 3) [m]
    triangles: IntArray  # node indices of the triangles, (F, 3)
    color: str  # color of the surface as ``#rrggbb``


@dataclass(frozen=True, kw_only=True)
class MovingPoints:
    """Points over time, (T, N, 3) [m]."""

    path: str
    time_s: Array
    points_m: Array
    color: str
    radius_m: float = 0.0015


@dataclass(frozen=True, kw_only=True)
class Plot:
    """One curve over time in the rerun viewer."""

    path: str
    time_s: Array
    value: Array
    name: str
    color: str


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Surfaces, points and plots of one recording; ``note`` is a text that opens beside it."""

    title: str
    note: str
    surfaces: Sequence[MovingSurface] = ()
    points: Sequence[MovingPoints] = ()
    plots: Sequence[Plot] = field(default_factory=tuple)


def write(scene: Scene, path: str | Path) -> Path:
    """Write the recording, in place of an older one only when it is whole.

    Raises:
        ImportError: rerun-sdk is not installed.
    """

    def log(rr: Any, stream: Any) -> None:
        stream.log("note", rr.TextDocument(scene.note, media_type="text/markdown"), static=True)
        for surface in scene.surfaces:
            _surface(rr, stream, surface)
        for points in scene.points:
            _points(rr, stream, points)
        for plot in scene.plots:
            _plot(rr, stream, plot)

    return write_recording(path, scene.title, log)


def write_recording(path: str | Path, title: str, log: Callable[[Any, Any], None]) -> Path:
    """Write what ``log(rerun, stream)`` logs, z up; the file appears only when it is whole.

    Raises:
        ImportError: rerun-sdk is not installed.
    """
    rr = optional("rerun", purpose="an .rrd recording")
    stream = rr.RecordingStream(f"diffsim {title}")
    kept = stream.memory_recording()  # where a disk gets full, its own writer waits for ever
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    log(rr, stream)
    return write_bytes_atomic(path, kept.drain_as_bytes())


def rgb(color: str) -> list[int]:
    """Red, green and blue, 0 to 255, of ``#rrggbb``."""
    return [int(color[i : i + 2], 16) for i in (1, 3, 5)]


def _surface(rr: Any, stream: Any, surface: MovingSurface) -> None:
    color = rgb(surface.color)
    for t, nodes in zip(surface.time_s, surface.nodes_m, strict=True):
        stream.set_time("time_since_release", duration=float(t))
        stream.log(
            surface.path,
            rr.Mesh3D(
                vertex_positions=nodes,
                triangle_indices=surface.triangles,
                vertex_normals=_normals(nodes, surface.triangles),
                albedo_factor=[*color, 255],
            ),
        )


def _normals(nodes: NDArray[np.float32], triangles: IntArray) -> NDArray[np.float32]:
    a, b, c = (nodes[triangles[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    normal = np.zeros_like(nodes)
    for i in range(3):
        np.add.at(normal, triangles[:, i], face)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _points(rr: Any, stream: Any, points: MovingPoints) -> None:
    for t, places in zip(points.time_s, points.points_m, strict=True):
        stream.set_time("time_since_release", duration=float(t))
        stream.log(
            points.path,
            rr.Points3D(places, colors=[rgb(points.color)], radii=[points.radius_m]),
        )


def _plot(rr: Any, stream: Any, plot: Plot) -> None:
    stream.log(plot.path, rr.SeriesLines(colors=[rgb(plot.color)], names=[plot.name]), static=True)
    stream.send_columns(
        plot.path,
        indexes=[rr.TimeColumn("time_since_release", duration=plot.time_s)],
        columns=rr.Scalars.columns(scalars=plot.value),
    )
