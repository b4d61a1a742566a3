"""Figures of the demo's page: curves given in SI units and drawn in millimeters.

``picture`` draws one twice: as wide as the page, and for a phone, one panel below the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diffsim.viz.figures import COLORS, INK, LINE, SOFT, data_uri, new_figure
from diffsim.viz.report import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
NARROW_INCH = 4.3  # a phone's page: letters of 9 points are 10 pixels high there
LEGEND_ROW_POINTS = 15.0  # height of a row of a legend above its panel


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One labeled line of a figure."""

    # x, y: (N,) in SI units
    x: Array
    y: Array
    label: str = ""  # text in the legend; empty: no entry
    role: str = "measured"  # key of ``COLORS``, or a color
    dashed: bool = False  # whether the line is dashed
    points: bool = False  # draw the samples as dots, too

    @property
    def color(self) -> str:
        return COLORS.get(self.role, self.role)


def picture(draw: Callable[[bool], Figure], caption: str) -> Picture:
    """A figure for a wide page and for a phone.

    Args:
        draw: Draws it; its argument says whether it is the one for a phone.
        caption: What to see.
    """
    return Picture(uri=data_uri(draw(False)), narrow=data_uri(draw(True)), caption=caption)


def one_panel(narrow: bool, *, width: float, height: float) -> tuple[Figure, Axes]:
    """A figure of one panel; ``width`` and ``height`` [inch] are those on a wide page."""
    figure, ax = new_figure(
        width=NARROW_INCH if narrow else width, height=3.6 if narrow else height
    )
    return figure, ax


def legend(ax: Axes, narrow: bool, **wide: Any) -> None:
    """The legend of a panel where ``wide`` has it; on a phone above the panel, below its title."""
    labels = ax.get_legend_handles_labels()[1]
    if not labels:
        return
    if narrow:
        columns = 2 if max(map(len, labels)) < 24 else 1  # letters in half a phone's width
        rows = -(-len(labels) // columns)
        ax.set_title(ax.get_title(loc="left"), loc="left", fontsize=10.5, color=INK,
                     fontweight="bold", pad=6.0 + LEGEND_ROW_POINTS * rows)  # fmt: skip
        wide = {"loc": "lower left", "bbox_to_anchor": (-0.02, 0.99), "ncols": columns}
    ax.legend(frameon=False, fontsize=8.5, labelcolor=INK, **wide)


def trajectories(
    panels: Sequence[tuple[str, Sequence[Curve]]], *, ylabel: str, narrow: bool = False
) -> Figure:
    """Curves over time since release [s], one panel per trial, millimeters."""
    figure, axes = _over_time(len(panels), narrow, height=2.5)
    for ax, (title, curves) in zip(axes, panels, strict=True):
        _draw_curves(ax, title, curves, narrow)
        ax.set_ylabel(ylabel, color=SOFT)
    axes[-1].set_xlabel("time since release [s]", color=SOFT)
    return figure


def spectra(
    panels: Sequence[tuple[str, Sequence[Curve]]],
    *,
    max_Hz: float,
    floor_m: float,
    narrow: bool = False,
) -> Figure:
    """Amplitude spectra [mm] over frequency [Hz], logarithmic, one panel per case."""
    figure, axes = _logarithmic(panels, "frequency [Hz]", "amplitude [mm]", narrow)
    for ax in axes:
        ax.set_xlim(0.0, max_Hz)
    axes[0].set_ylim(bottom=floor_m * 1e3)  # last: a limit set early stops the autoscale
    return figure


def decay_envelopes(
    panels: Sequence[tuple[str, Sequence[Curve]]], *, narrow: bool = False
) -> Figure:
    """Swing heights [mm] over time, logarithmic: a constant damping ratio is a straight line."""
    y = "swing from turn to turn [mm]"
    return _logarithmic(panels, "time since release [s]", y, narrow)[0]


def residuals(
    panels: Sequence[tuple[str, Sequence[Curve], Curve | None]],
    *,
    ylabel: str,
    narrow: bool = False,
) -> Figure:
    """Simulation minus measurement over time [mm], over the band that repeats span.

    Args:
        panels: (title, curves, floor): ``floor.y`` >= 0 is half the height of the grey band.
        ylabel: Label of the vertical axis of every panel.
        narrow: Whether it is drawn for a phone.
    """
    figure, axes = _over_time(len(panels), narrow, height=1.9)
    for ax, (title, curves, floor) in zip(axes, panels, strict=True):
        if floor is not None:
            ax.fill_between(
                floor.x, -1e3 * floor.y, 1e3 * floor.y, color=LINE, lw=0, label=floor.label
            )
        ax.axhline(0.0, color=SOFT, lw=0.6)
        _draw_curves(ax, title, curves, narrow)
        ax.set_ylabel(ylabel, color=SOFT)
    axes[-1].set_xlabel("time since release [s]", color=SOFT)
    return figure


def bars(
    groups: Sequence[str],
    series: Sequence[tuple[str, Sequence[float], str]],
    *,
    ylabel: str,
    reference: Sequence[float] | None = None,
    reference_label: str = "",
    log: bool = False,
    narrow: bool = False,
) -> Figure:
    """Grouped bars with values on top; ``reference`` draws a level across each group.

    Args:
        groups: Names of the groups on the axis.
        series: (label, one value per group, role or color); NaN leaves a gap.
        log: Whether the axis of values is logarithmic.
        narrow: Whether it is drawn for a phone.
    """
    figure, ax = one_panel(narrow, width=9.6, height=3.4)
    width = 0.8 / max(len(series), 1)
    at = np.arange(len(groups))
    for i, (label, values, role) in enumerate(series):
        x = at + (i - (len(series) - 1) / 2) * width
        drawn = ax.bar(x, values, width * 0.92, label=label, color=COLORS.get(role, role))
        texts = ["" if np.isnan(v) else f"{v:.2g}" for v in values]
        turned = 90 if narrow else 0
        ax.bar_label(drawn, texts, padding=2, fontsize=7.5, color=SOFT, rotation=turned)
    if reference is not None:
        for i, value in enumerate(reference):
            label = reference_label if i == 0 else "_"
            ax.plot([i - 0.42, i + 0.42], [value, value], color=INK, lw=1.6, label=label)
    ax.set_xticks(at, groups)
    ax.set_ylabel(ylabel, color=SOFT)
    ax.grid(False, axis="x")
    if log:
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
    ax.margins(y=0.14)
    legend(ax, narrow, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    return figure


def _over_time(count: int, narrow: bool, *, height: float) -> tuple[Figure, list[Axes]]:
    """Panels over one time, each ``height`` [inch]."""
    size = (
        {"width": NARROW_INCH, "height": 3.2 * count}
        if narrow
        else {"height": height * count + 0.4}
    )
    figure, axes = new_figure(count, 1, sharex=True, squeeze=False, **size)
    return figure, list(axes[:, 0])


def _logarithmic(
    panels: Sequence[tuple[str, Sequence[Curve]]], xlabel: str, ylabel: str, narrow: bool
) -> tuple[Figure, list[Axes]]:
    """Panels beside each other, on a phone below."""
    count = len(panels)
    shape = (count, 1) if narrow else (1, count)
    width, height = (NARROW_INCH, 3.2 * count) if narrow else (9.6, 3.4)
    figure, grid = new_figure(*shape, width=width, height=height, sharey=True, squeeze=False)
    axes = list(grid.flat)
    for ax, (title, curves) in zip(axes, panels, strict=True):
        _draw_curves(ax, title, curves, narrow, columns=1)
        ax.set_yscale("log")
    for ax in axes[-1:] if narrow else axes:
        ax.set_xlabel(xlabel, color=SOFT)
    for ax in axes if narrow else axes[:1]:
        ax.set_ylabel(ylabel, color=SOFT)
    return figure, axes


def _draw_curves(
    ax: Axes, title: str, curves: Sequence[Curve], narrow: bool, columns: int = 4
) -> None:
    for curve in curves:
        ax.plot(
            curve.x,
            1e3 * np.asarray(curve.y),
            color=curve.color,
            lw=1.3,
            ls="--" if curve.dashed else "-",
            marker="o" if curve.points else None,
            ms=2.6,
            label=curve.label or "_",
        )
    ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
    legend(ax, narrow, ncols=max(min(sum(bool(c.label) for c in curves), columns), 1))
