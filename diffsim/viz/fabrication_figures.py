"""Figures of a fabrication plan: the copter, its wiring from above, rods in bars, printed parts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.optional import optional
from diffsim.viz.figures import COLORS, CYCLE, INK, LINE, SOFT, new_figure

if TYPE_CHECKING:
    import trimesh
    from matplotlib.figure import Figure

    from diffsim.copter.fabrication.motors import MotorPlan
    from diffsim.copter.fabrication.planner import PrintedPart
    from diffsim.copter.fabrication.rods import StockBar

_CLOCKWISE, _COUNTER = COLORS["fitted"], COLORS["published"]
_MATERIALS = {
    "rod": "#3a3f4a",
    "plate": "#93a7b8",
    "frame": "#b3362a",
    "motor": "#7d8794",
    "propeller": "#1d2433",
    "battery": "#3c6ea5",
    "electronics": "#2c7a4b",
    "clip": "#d98c1f",
}
_PRINTED = "#d9b48a"
_LIGHT = np.array([0.3, -0.5, 0.81])


def view(meshes: Mapping[str, trimesh.Trimesh], kinds: Mapping[str, str]) -> Figure:
    """All parts from the front left above.

    Args:
        meshes: Surfaces by part, NED [m].
    """
    width, height = 9.6, 5.8
    figure = optional("matplotlib.figure", purpose="a figure").Figure(figsize=(width, height))
    figure.set_facecolor("none")
    square = width / height  # 3-D axes are drawn in the middle square of theirs
    ax = figure.add_axes((0.0, 0.5 - 0.5 * square, 1.0, square), projection="3d")
    triangles = [_cut_small(m) * [1.0, -1.0, -1.0] for m in meshes.values()]
    colors = [_shade_triangles(t, _color(kinds[n])) for n, t in zip(meshes, triangles, strict=True)]
    _draw_triangles(ax, np.concatenate(triangles), np.concatenate(colors), 32.0, 52.0, 0.9)
    return figure


def wiring(
    motors: Sequence[MotorPlan],
    shapes: Sequence[tuple[str, Array]],
) -> Figure:
    """Motors from above: numbers, senses of rotation, front.

    Args:
        shapes: Kind and triangles of structural parts, front-right-down relative to the center of
            mass, (num_triangles, 3, 3) [m].
    """
    figure, ax = new_figure(width=9.6, height=7.6)
    patches = optional("matplotlib.patches", purpose="a figure")
    collections = optional("matplotlib.collections", purpose="a figure")
    for kind, triangles in shapes:
        flat = 1e3 * triangles[..., [1, 0]]  # right, front
        ax.add_collection(
            collections.PolyCollection(
                flat, facecolor=_make_pale(_color(kind)), linewidth=0.3, edgecolor="face", zorder=1
            )
        )
    hangs = {m.number: _upper_twin(m, motors) for m in motors}
    for m in motors:
        _draw_motor(ax, patches, m, hangs[m.number])
    ax.plot(0.0, 0.0, "+", color=INK, markersize=11, zorder=5)
    ax.annotate(
        "center of mass",
        (0.0, 0.0),
        (6.0, 6.0),
        textcoords="offset points",
        color=SOFT,
        fontsize=8.5,
    )
    reach = max(1e3 * (np.hypot(*m.position[:2]) + m.radius) for m in motors)
    ax.annotate(
        "front",
        (0.0, 1.17 * reach),
        (0.0, 1.02 * reach),
        ha="center",
        va="top",
        color=INK,
        fontweight="bold",
        arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 2.0},
        zorder=6,
    )
    handles = [
        patches.Patch(facecolor=_CLOCKWISE, alpha=0.6, label="clockwise"),
        patches.Patch(facecolor=_COUNTER, alpha=0.6, label="counter-clockwise"),
    ]
    if any(hangs.values()):
        handles.append(
            patches.Patch(fill=False, edgecolor=SOFT, linestyle="--", label="below, upside down")
        )
    ax.legend(handles=handles, frameon=False, loc="lower left", fontsize=9)
    ax.set_aspect("equal")
    ax.set_ylim(-1.1 * reach, 1.2 * reach)
    ax.set_xlim(-1.25 * reach, 1.25 * reach)
    ax.set_xlabel("right [mm]", color=SOFT)
    ax.set_ylabel("front [mm]", color=SOFT)
    return figure


def bars(stock: Sequence[StockBar]) -> Figure:
    """Cuts of each stock bar."""
    figure, ax = new_figure(width=9.6, height=0.8 + 0.42 * len(stock))
    labels = sorted({label for bar in stock for label, _ in bar.pieces})
    colors = {label: CYCLE[k % 4] for k, label in enumerate(labels)}
    for row, bar in enumerate(stock):
        ax.barh(row, 1e3 * bar.length, color=LINE, height=0.6)
        start = 0.0
        for label, length in bar.pieces:
            ax.barh(row, 1e3 * length, left=1e3 * start, color=colors[label], height=0.6)
            ax.text(
                1e3 * (start + 0.5 * length),
                row,
                f"{label}  {1e3 * length:.1f}",
                ha="center",
                va="center",
                color="white",
                fontsize=8.5 if length > 0.1 * bar.length else 6.0,
            )
            start += length + bar.kerf
    ax.set_yticks(range(len(stock)), [f"bar {k + 1}" for k in range(len(stock))])
    ax.invert_yaxis()
    ax.grid(visible=False)
    ax.set_xlabel("along the bar [mm]; gray: waste", color=SOFT)
    return figure


def printed(parts: Sequence[PrintedPart], columns: int = 4) -> Figure:
    """Every mesh as it stands on the bed, each to its own scale."""
    rows = -(-len(parts) // columns)
    columns = min(columns, len(parts))
    figure = optional("matplotlib.figure", purpose="a figure").Figure(figsize=(9.6, 2.9 * rows))
    figure.set_facecolor("none")
    for k, part in enumerate(parts):
        ax = figure.add_subplot(rows, columns, k + 1, projection="3d")
        triangles = part.mesh.triangles
        color = _color("clip") if "clip" in part.file else _PRINTED
        _draw_triangles(ax, triangles, _shade_triangles(triangles, color), 28.0, -60.0, 1.0)
        size = " x ".join(f"{v:.0f}" for v in part.check.size)
        name = part.file.removesuffix(".stl").replace("_", " ")
        ax.set_title(f"{name}\n{len(part.names)} pcs, {size} mm", fontsize=8.5, color=INK, y=1.0)
    figure.subplots_adjust(0.0, 0.0, 1.0, 1.0 - 0.24 / rows, 0.05, 0.2)
    return figure


def _cut_small(mesh: trimesh.Trimesh) -> Array:
    """Triangles cut up to sides of 15 mm: they are drawn by the distance of their middles."""
    remesh = optional("trimesh.remesh", purpose="a figure")
    vertices, faces = remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge=0.015)
    return vertices[faces]


def _draw_motor(ax: Any, patches: Any, m: MotorPlan, hangs: bool) -> None:
    x, y = 1e3 * m.position[1], 1e3 * m.position[0]
    color = _CLOCKWISE if m.clockwise else _COUNTER
    radius = 1e3 * m.radius * (0.8 if hangs else 1.0)  # else it would hide under its twin
    line = "--" if hangs else "-"
    fill = 0.0 if hangs else 0.12
    ax.add_patch(
        patches.Circle((x, y), radius, facecolor=color, alpha=fill, edgecolor="none", zorder=2)
    )
    ax.add_patch(
        patches.Circle(
            (x, y), radius, fill=False, edgecolor=color, linestyle=line, linewidth=1.2, zorder=3
        )
    )
    ends = np.deg2rad([30.0, 100.0])  # counterclockwise on paper
    if m.clockwise:
        ends = ends[::-1]
    for turn in (0.0, np.pi):
        tail, head = (
            (x + 0.8 * radius * np.cos(a + turn), y + 0.8 * radius * np.sin(a + turn)) for a in ends
        )
        ax.add_patch(
            patches.FancyArrowPatch(
                tail,
                head,
                connectionstyle=f"arc3,rad={-0.32 if m.clockwise else 0.32}",
                arrowstyle="-|>",
                mutation_scale=15,
                color=color,
                linewidth=2.0,
                zorder=4,
            )
        )
    drop = -0.42 * radius if hangs else 0.0
    ax.text(
        x, y + drop, str(m.number), ha="center", va="center", fontsize=15 if not hangs else 12,
        fontweight="bold", color=color, zorder=6,
        bbox={"boxstyle": "circle,pad=0.25", "facecolor": "white", "edgecolor": color},
    )  # fmt: skip
    if m.clip is not None:
        text = f"{m.tilt:.1f}° to {m.azimuth:.0f}°"
        ax.text(x, y - 0.34 * radius, text, ha="center", va="center", fontsize=9, color=INK,
                zorder=6)  # fmt: skip


def _upper_twin(m: MotorPlan, motors: Sequence[MotorPlan]) -> bool:
    """Whether another motor sits right above (coaxial pairs)."""
    return any(
        o.number != m.number
        and np.hypot(o.position[0] - m.position[0], o.position[1] - m.position[1]) < 0.01
        and o.position[2] < m.position[2]
        for o in motors
    )


def _make_pale(color: str) -> Any:
    """A third of a color on white."""
    colors = optional("matplotlib.colors", purpose="a figure")
    return tuple(1.0 - 0.33 * (1.0 - c) for c in colors.to_rgb(color))


def _color(kind: str) -> str:
    return next((color for key, color in _MATERIALS.items() if key in kind), _PRINTED)


def _shade_triangles(triangles: Array, color: str) -> Array:
    """Color by the angle to the light, (num_triangles, 4)."""
    colors = optional("matplotlib.colors", purpose="a figure")
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    facing = (normals / np.where(lengths > 0.0, lengths, 1.0)) @ _LIGHT
    bright = 0.85 + 0.3 * np.clip(facing, -1.0, 1.0)[:, None]
    rgb = np.clip(np.array(colors.to_rgb(color)) * bright, 0.0, 1.0)
    return np.column_stack([rgb, np.ones(len(rgb))])


def _draw_triangles(
    ax: Any, triangles: Array, colors: Array, elev: float, azim: float, zoom: float
) -> None:
    """Triangles that face the viewer, who looks from these angles [deg]; others would hide them."""
    art = optional("mpl_toolkits.mplot3d.art3d", purpose="a figure")
    e, a = np.deg2rad([elev, azim])
    viewer = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    seen = normals @ viewer > 0.0
    surface = art.Poly3DCollection(
        triangles[seen], facecolors=colors[seen], edgecolors="none", antialiaseds=False
    )
    ax.add_collection3d(surface)
    lower, upper = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    for axis, first, last in zip("xyz", lower, upper, strict=True):
        getattr(ax, f"set_{axis}lim")(first, last)
    ax.set_box_aspect(upper - lower, zoom=zoom)
    ax.set_proj_type("ortho")
    ax.view_init(elev=elev, azim=azim)
    ax.set_axis_off()
    ax.patch.set_alpha(0.0)
