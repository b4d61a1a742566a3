"""Pictures of Stokes flows: speed maps with streamlines, slices, views in three dimensions.

Every function returns a ``matplotlib.figure.Figure`` in the style of ``diffsim.viz.figures``;
``diffsim.viz.figures.data_uri`` turns it into text, ``save`` into a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.optional import optional
from diffsim.stokes.fabrication import wall_mesh
from diffsim.stokes.field import FlowField
from diffsim.stokes.streamlines import Streamline, streamlines
from diffsim.viz._flow_cut import FINE, Cut, Plane, cut_through, length_unit
from diffsim.viz.figures import COLORS, INK, LINE, SOFT, new_figure
from diffsim.viz.figures import save as save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


SPEED = ("#f3f8f8", "#b9dcd9", "#62b3b2", "#0b7f86", "#0d5163", "#152a3f")
"""Colors from rest to the greatest speed, in equal steps; light to dark also in gray."""
SOLID = "#c9ced6"


def speed_map(
    field: FlowField,
    *,
    case: int = 0,
    title: str = "",
    lines: int | Sequence[Streamline] = 20,
    max_speed: float | None = None,
) -> Figure:
    """A 2D flow: speed in color, streamlines of equal flow between them, solid gray.

    Args:
        field: A flow in two dimensions.
        case: Index of the inlet case.
        title: Title above the picture.
        lines: Streamlines, or how many to start where fluid enters; 0 draws none.
        max_speed: Upper end of the color scale [m/s]; default the greatest in the fluid.
    """
    return compare([(title, field)], case=case, lines=lines, max_speed=max_speed)


def compare(
    panels: Sequence[tuple[str, FlowField]],
    *,
    case: int = 0,
    plane: Plane | None = None,
    lines: int | Sequence[Streamline] = 20,
    max_speed: float | None = None,
) -> Figure:
    """Flows side by side on one color scale, such as the initial and the optimized design.

    Args:
        case: Index of the inlet case.
        plane: Plane of 3D flows, such as ("z", 0.5): axis and position in the box [share of its
            side].
        lines: Number of streamlines, as in ``speed_map``; the same count in every panel. 2D flows
            only.
        max_speed: Upper end of the color scale [m/s]; default the greatest that is drawn.
    """
    _check_fields([field for _, field in panels])
    cuts = [cut_through(field, case, plane) for _, field in panels]
    top = max_speed or max(cut.top_speed for cut in cuts)
    ratio = max(cut.sides[1] / cut.sides[0] for cut in cuts)
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    width = 9.6 if columns > 1 or ratio < 0.7 else 6.4
    panel = (width - 1.4) / columns
    figure, axes = new_figure(
        rows, columns, width=width, height=rows * (panel * ratio + 0.72), squeeze=False
    )
    image = None
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    for (title, field), cut, ax in zip(panels, cuts, axes.flat, strict=False):
        image = _draw_cut(ax, cut, top)
        if field.grid.dim == 2:
            drawn = lines if not isinstance(lines, int) else _lines(field, lines, case)
            _draw_lines(ax, drawn, cut.scale)
        else:
            _draw_arrows(ax, cut, max(cut.sides), top)
        _label(ax, title, cut)
    for ax in axes[:, 1:].flat:
        ax.set_ylabel("")
    _speed_bar(figure, image, axes, top)
    return figure


def slices(
    field: FlowField,
    planes: Sequence[Plane] = (("z", 0.5), ("y", 0.5), ("x", 0.5)),
    *,
    case: int = 0,
    title: str = "",
    max_speed: float | None = None,
) -> Figure:
    """Planes through a 3D flow: speed in color, arrows of the velocity within, solid gray.

    Every plane has its own longest arrow, so that weak flow across the main one is seen.

    Args:
        field: A flow in three dimensions.
        planes: Axis and position in the box [share of its side] of each plane.
        case: Index of the inlet case.
        title: Title above the picture.
        max_speed: Upper end of the color scale [m/s]; default the greatest that is drawn.
    """
    _check_fields([field], dim=3)
    cuts = [cut_through(field, case, plane) for plane in planes]
    top = max_speed or max(cut.top_speed for cut in cuts)
    widths = [cut.sides[0] for cut in cuts]
    tall = max(cut.sides[1] for cut in cuts) / sum(widths)
    figure, axes = new_figure(
        1,
        len(cuts),
        height=7.6 * tall + (0.85 if title else 0.65),
        squeeze=False,
        gridspec_kw={"width_ratios": widths},
    )
    image = None
    for cut, ax in zip(cuts, axes[0], strict=True):
        image = _draw_cut(ax, cut, top)
        _draw_arrows(ax, cut, 0.5 * sum(widths), top)
        _label(ax, cut.name, cut)
    if title:
        figure.suptitle(title, x=0.012, ha="left", fontsize=12, color=INK, fontweight="bold")
    _speed_bar(figure, image, axes, top)
    return figure


def view(
    panels: Sequence[tuple[str, FlowField]] | FlowField,
    *,
    case: int = 0,
    lines: int | Sequence[Streamline] = 60,
    max_speed: float | None = None,
    elevation: float = 24.0,
    azimuth: float = -58.0,
) -> Figure:
    """3D flows: streamlines colored by speed within the translucent wall.

    Args:
        panels: A flow in three dimensions, or (title, flow) for several side by side.
        case: Index of the inlet case.
        lines: Streamlines, or how many to start where fluid enters.
        max_speed: Upper end of the color scale [m/s]; default the greatest on the lines.
        elevation, azimuth: Elevation and azimuth of the viewer [degrees].
    """
    if isinstance(panels, FlowField):
        panels = [("", panels)]
    _check_fields([field for _, field in panels], dim=3)
    art3d = optional("mpl_toolkits.mplot3d.art3d", purpose="a view in three dimensions")
    optional("mpl_toolkits.mplot3d", purpose="a view in three dimensions")
    ticker = optional("matplotlib.ticker", purpose="a view in three dimensions")
    drawn = [_lines(f, lines, case) if isinstance(lines, int) else lines for _, f in panels]
    top = max_speed or max(float(line.speed.max()) for some in drawn for line in some)
    count = len(panels)
    figure, axes = new_figure(
        1, count, width=9.6 if count > 1 else 7.4, height=4.0 if count > 1 else 5.6,
        squeeze=False, subplot_kw={"projection": "3d", "computed_zorder": False},
    )  # fmt: skip
    image = None
    for (title, field), some, ax in zip(panels, drawn, axes[0], strict=True):
        scale, unit = length_unit(field)
        wall = wall_mesh(field.grid, field.phi)
        ax.set_proj_type("persp", focal_length=1.6)
        ax.view_init(elevation, azimuth)
        faces = art3d.Poly3DCollection(
            wall.triangles * scale,
            facecolors=_shade_wall(wall.face_normals),
            linewidths=0,
            zorder=1,
        )
        ax.add_collection3d(faces)
        pieces = [np.stack([p.points[:-1], p.points[1:]], 1) * scale for p in some]
        speed = np.concatenate([0.5 * (p.speed[1:] + p.speed[:-1]) for p in some])
        image = art3d.Line3DCollection(
            np.concatenate(pieces), cmap=_line_colors(), linewidths=1.1, zorder=2
        )
        image.set_array(speed)
        image.set_clim(0.0, top)
        ax.add_collection3d(image)
        _box(ax, field, scale)
        longest = max(field.grid.size)
        sides = zip("xyz", (ax.xaxis, ax.yaxis, ax.zaxis), field.grid.size, strict=True)
        for name, axis, side in sides:
            axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
            axis.line.set_color(LINE)
            axis.set_label_text(f"{name} [{unit}]", color=SOFT, fontsize=8.5)
            axis.set_tick_params(labelsize=7.5, colors=SOFT, pad=0)
            # labels of a short side would overlap
            axis.set_major_locator(ticker.MaxNLocator(3 if side > 0.3 * longest else 1))
        ax.grid(False)
        ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
    _speed_bar(figure, image, axes, top, pad=0.075)
    return figure


def _check_fields(fields: Sequence[FlowField], dim: int | None = None) -> None:
    if not fields:
        raise ValueError("panels must hold at least one flow")
    for field in fields:
        if not isinstance(field, FlowField):
            raise TypeError(f"field must be a FlowField, got {type(field).__name__}")
        if dim is not None and field.grid.dim != dim:
            raise ValueError(f"this picture is of flows in {dim}D, got {field.grid.dim}D")


def _lines(field: FlowField, count: int, case: int) -> list[Streamline]:
    return streamlines(field, count, case=case) if count else []


def _colors() -> Any:
    colors = optional("matplotlib.colors", purpose="a picture of a flow")
    return colors.LinearSegmentedColormap.from_list("speed", SPEED)


def _line_colors() -> Any:
    """The same without its lightest part, which would not be seen on white."""
    colors = optional("matplotlib.colors", purpose="a picture of a flow")
    return colors.LinearSegmentedColormap.from_list("lines", ["#8fd0cb", *SPEED[2:]])


def _draw_cut(ax: Axes, cut: Cut, top: float) -> Any:
    ax.grid(False)
    image = ax.imshow(
        np.where(cut.phi > 0, cut.speed, 0.0).T,
        origin="lower", extent=cut.extent, cmap=_colors(), vmin=0.0, vmax=top,
        interpolation="bilinear",
    )  # fmt: skip
    x, y = cut.scale * cut.x, cut.scale * cut.y
    # samples are half a pixel inside of the box: carry the wall on to its edge
    x = np.concatenate([cut.extent[:1], x, cut.extent[1:2]])
    y = np.concatenate([cut.extent[2:3], y, cut.extent[3:]])
    phi = np.pad(cut.phi, 1, mode="edge").T
    if phi.min() < 0.0:
        ax.contourf(x, y, phi, levels=[min(phi.min() * 1.01, -1e-300), 0.0], colors=[SOLID])
        if phi.max() > 0.0:
            ax.contour(x, y, phi, levels=[0.0], colors=[INK], linewidths=1.1)
    ax.set_xlim(cut.extent[0], cut.extent[1])
    ax.set_ylim(cut.extent[2], cut.extent[3])
    ax.set_aspect("equal")
    return image


def _draw_lines(ax: Axes, lines: Sequence[Streamline], scale: float) -> None:
    """Lines, each with an arrow head in the middle of its length."""
    effects = optional("matplotlib.patheffects", purpose="a picture of a flow")
    # seen on dark colors, too
    halo = [effects.withStroke(linewidth=1.6, foreground="#ffffff90")]
    for line in lines:
        points = scale * line.points
        if len(points) < 3:
            continue
        ax.plot(*points.T, color=INK, lw=0.65, alpha=0.8, path_effects=halo)
        length = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))
        k = int(np.searchsorted(length, 0.5 * length[-1]))
        k = min(max(k, 0), len(points) - 2)
        ax.annotate(
            "", points[k + 1], points[k],
            arrowprops={"arrowstyle": "-|>,head_width=0.14,head_length=0.28", "color": INK,
                        "lw": 0.0, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip


def _draw_arrows(ax: Axes, cut: Cut, width: float, top: float, count: int = 18) -> None:
    """The velocity within the plane, ``count`` arrows along ``width`` [m].

    The longest fills its gap. A plane with less than a hundredth of the ``top`` speed has none.
    """
    pixels = [FINE * n for n in cut.cells]
    gap = width / count
    step = [max(1, round(gap / s * n)) for s, n in zip(cut.sides, pixels, strict=True)]
    i = np.arange(step[0] // 2, pixels[0], step[0])
    j = np.arange(step[1] // 2, pixels[1], step[1])
    v = cut.velocity[np.ix_(i, j)][..., cut.axes]
    within = np.where(cut.phi[np.ix_(i, j)] > 0, np.linalg.norm(v, axis=-1), 0.0)
    if within.max(initial=0.0) < 0.01 * top:
        return
    seen = within > 0.05 * within.max()
    x, y = np.meshgrid(cut.scale * cut.x[i], cut.scale * cut.y[j], indexing="ij")
    ax.quiver(
        x[seen], y[seen], v[seen][:, 0], v[seen][:, 1], color=COLORS["published"],
        angles="xy", scale_units="xy", scale=within.max() / (1.05 * gap * cut.scale), pivot="mid",
        units="inches", width=0.016, headwidth=3.4, headlength=3.8, headaxislength=3.4,
        minlength=0.5,
    )  # fmt: skip


def _label(ax: Axes, title: str, cut: Cut) -> None:
    ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
    ax.set_xlabel(f"{'xyz'[cut.axes[0]]} [{cut.unit}]", color=SOFT, fontsize=9)
    ax.set_ylabel(f"{'xyz'[cut.axes[1]]} [{cut.unit}]", color=SOFT, fontsize=9)


def _speed_bar(figure: Figure, image: Any, axes: Any, top: float, pad: float = 0.02) -> None:
    bar = figure.colorbar(image, ax=list(np.ravel(axes)), shrink=0.82, pad=pad, aspect=24)
    exponent = np.floor(np.log10(top)) if top > 0 else 0.0
    factor, unit = (
        (1.0, "m/s") if exponent >= -1 else (1e3, "mm/s") if exponent >= -4 else (1e6, "um/s")
    )
    bar.set_label(f"speed [{unit}]", color=SOFT, fontsize=9)
    bar.ax.yaxis.set_major_formatter(lambda value, _: f"{factor * value:.3g}")
    bar.ax.tick_params(colors=SOFT, labelsize=8.5, length=3)
    bar.outline.set_edgecolor(LINE)


def _shade_wall(normals: Array) -> Array:
    """Gray of a wall in light from above left, translucent."""
    light = np.array([-0.4, -0.5, 0.77])
    shade = 0.62 + 0.3 * np.abs(normals @ light)
    return np.stack([0.93 * shade, 0.96 * shade, shade, np.full_like(shade, 0.17)], axis=-1)


def _box(ax: Any, field: FlowField, scale: float) -> None:
    """The edges of the box, and equal axes."""
    low = scale * np.array(field.grid.origin)
    size = scale * np.array(field.grid.size)
    for a in range(3):
        b, c = (k for k in range(3) if k != a)
        for u in (0.0, 1.0):
            for w in (0.0, 1.0):
                ends = np.tile(low, (2, 1))
                ends[:, b] += u * size[b]
                ends[:, c] += w * size[c]
                ends[1, a] += size[a]
                ax.plot(*ends.T, color=LINE, lw=0.8, zorder=0)
    ax.set_xlim(low[0], low[0] + size[0])
    ax.set_ylim(low[1], low[1] + size[1])
    ax.set_zlim(low[2], low[2] + size[2])
    ax.set_box_aspect(size / size.max(), zoom=0.9)
