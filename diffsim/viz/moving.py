"""A body or a vehicle that moves, to turn and play in a page: data for ``templates/moving.js``.

Positions are whole numbers of 16 bits over the box of their part: finer than a screen shows, and a
second of a mesh of a thousand nodes takes 200 kB. The page draws them on a plain canvas, so that it
needs neither a network nor a graphics card.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Ints = NDArray[np.integer]

MAX_BYTES = 700_000  # of a view in the page: with plotly and its curves it stays below 3 MB
MAX_TRIANGLES = 30_000  # of a view: a plain canvas draws that many ten times a second
FRAME_RATE = 25.0  # of bodies that move [Hz]
_LEVELS = 65535


@dataclass(frozen=True, kw_only=True, eq=False)
class Deforming:
    """A surface whose nodes move."""

    name: str  # what the button that hides it says
    color: str  # color of the part, as ``#rrggbb``
    triangles: Ints  # node indices, (num_triangles, 3)
    nodes_m: Array  # positions over time, z up, (num_frames, num_nodes, 3) [m]
    opacity: float = 1.0  # less than 1 where another surface shows through
    # its triangles are seen counter-clockwise from outside, and only from there
    closed: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class Rigid:
    """A surface that moves as a whole."""

    name: str  # what the button that hides it says; parts of one name share a button
    color: str  # color of the part, as ``#rrggbb``
    triangles: Ints  # node indices, (num_triangles, 3)
    nodes_m: Array  # positions in its own frame, (num_nodes, 3) [m]
    turns: Array  # rotations to the world, z up, (num_frames, 3, 3)
    places_m: Array  # its origin in the world, (num_frames, 3) [m]


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """A line that does not move, such as a flown path, (num_points, 3) [m]."""

    name: str
    color: str
    points_m: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Moving:
    """A view of things that move on one clock.

    Raises:
        ValueError: frames that do not fit the times, positions that are not finite, no parts, or
            more triangles than a page draws.
    """

    time_s: Array  # times of the frames, (num_frames,) [s], ascending
    parts: Sequence[Deforming | Rigid | Line]  # what is shown
    caption: str  # what to see

    def __post_init__(self) -> None:
        count = len(self.time_s)
        if not self.parts or count == 0:
            raise ValueError("a view needs a part and a frame at least")
        for part in self.parts:
            fixed = ("name", "color", "triangles", "opacity", "closed")
            arrays = [v for k, v in vars(part).items() if k not in fixed]
            if not all(np.isfinite(a).all() for a in arrays):
                raise ValueError(f"positions of {part.name!r} must be finite")
            frames = {Deforming: "nodes_m", Rigid: "turns"}.get(type(part))
            if frames is not None and len(getattr(part, frames)) != count:
                raise ValueError(
                    f"{part.name!r} must have {count} frames, as time_s has, got "
                    f"{len(getattr(part, frames))}"
                )
        total = sum(len(p.triangles) for p in self.parts if not isinstance(p, Line))
        if total > MAX_TRIANGLES:
            raise ValueError(
                f"a view draws at most {MAX_TRIANGLES:,} triangles, got {total:,}; show the "
                "boundary alone, or convex hulls of parts"
            )

    @property
    def html(self) -> str:
        """Data of the view for the page's script."""
        return _json(self.content())

    def content(self, max_bytes: float = MAX_BYTES) -> dict[str, Any]:
        """Times, parts and box; frames are left out evenly until the view fits ``max_bytes``."""
        step = 1
        while _num_bytes(self, step) > max_bytes and step < len(self.time_s):
            step += 1
        kept = np.arange(0, len(self.time_s), step)
        low, high = _box(self.parts)
        return {
            "time": [round(float(t), 5) for t in self.time_s[kept]],
            "low": low.tolist(),
            "high": high.tolist(),
            "parts": [_pack_part(part, kept) for part in self.parts],
        }


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingChoice:
    """Views in one place, with a menu to choose by."""

    views: Mapping[str, Moving]  # views by name, such as runs; one or more
    caption: str  # what to see

    def __post_init__(self) -> None:
        if not self.views:
            raise ValueError("views must hold one or more")

    @property
    def html(self) -> str:
        """Data of all views for the page's script; they share ``MAX_BYTES``."""
        share = MAX_BYTES / len(self.views)
        return _json([{"name": n, **view.content(share)} for n, view in self.views.items()])


def _json(content: Any) -> str:
    """As it may stand in a script of a page."""
    return json.dumps(content, separators=(",", ":")).replace("</", "<\\/")


def script() -> str:
    """The script that draws the views, to stand once in a page."""
    return resources.files("diffsim.viz").joinpath("templates/moving.js").read_text("utf-8")


def _num_bytes(view: Moving, step: int) -> float:
    """Length of the positions as base64."""
    frames = len(range(0, len(view.time_s), step))
    total = 0
    for part in view.parts:
        if isinstance(part, Deforming):
            total += 6 * frames * part.nodes_m.shape[1] + 6 * len(part.triangles)
        elif isinstance(part, Rigid):
            total += 48 * frames + 6 * len(part.nodes_m) + 6 * len(part.triangles)
        else:
            total += 6 * len(part.points_m)
    return total * 4 / 3


def _box(parts: Sequence[Deforming | Rigid | Line]) -> tuple[Array, Array]:
    """Corners of the box that all of it stays in."""
    corners = []
    for part in parts:
        if isinstance(part, Rigid):
            reach = np.linalg.norm(part.nodes_m, axis=1).max()
            corners += [part.places_m.min(0) - reach, part.places_m.max(0) + reach]
        else:
            points = part.nodes_m if isinstance(part, Deforming) else part.points_m
            corners += [points.reshape(-1, 3).min(0), points.reshape(-1, 3).max(0)]
    return np.min(corners, axis=0), np.max(corners, axis=0)


def _pack_part(part: Deforming | Rigid | Line, kept: Ints) -> dict[str, Any]:
    said: dict[str, Any] = {"name": part.name, "color": part.color}
    if isinstance(part, Line):
        return said | {"kind": "line", **_quantize_points(part.points_m)}
    size = part.nodes_m.shape[-2]
    said["triangles"] = _encode_array(part.triangles.astype("<u2" if size <= _LEVELS else "<u4"))
    said["wide"] = size > _LEVELS
    if isinstance(part, Deforming):
        said |= {"opacity": part.opacity, "closed": part.closed}
        return said | {"kind": "deforming", "nodes": size, **_quantize_points(part.nodes_m[kept])}
    poses = np.concatenate([part.turns[kept].reshape(-1, 9), part.places_m[kept]], axis=1)
    return said | {
        "kind": "rigid",
        "nodes": size,
        "poses": _encode_array(poses.astype("<f4")),
        **_quantize_points(part.nodes_m),
    }


def _quantize_points(points: Array) -> dict[str, Any]:
    flat = points.reshape(-1, 3).astype(np.float64)
    low, high = flat.min(0), flat.max(0)
    size = np.maximum(high - low, 1e-12)
    levels = np.round((flat - low) / size * _LEVELS).astype("<u2")
    return {"from": low.tolist(), "size": size.tolist(), "levels": _encode_array(levels)}


def _encode_array(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
