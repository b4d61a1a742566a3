"""Figures for reports: matplotlib objects made without pyplot, so no global state is touched.

Every function returns a ``matplotlib.figure.Figure``; ``data_uri`` turns it into text for a page.
Curves are given in SI units and drawn in millimeters.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

INK, SOFT, LINE = "#1d2433", "#5b6475", "#d9dde4"
#: Colors by role; readable for color-blind readers and in grey (Okabe and Ito, darkened).
COLORS = {
    "measured": "#1d2433",
    "measured_2": "#8a93a3",
    "published": "#c2571a",
    "fitted": "#0b6e75",
    "third": "#7a4fa3",
    "fourth": "#b08a00",
    "bad": "#b3362a",
}
CYCLE = ("#0b6e75", "#c2571a", "#7a4fa3", "#b08a00", "#1d2433", "#8a93a3", "#4f8a3c")


@dataclass(frozen=True, kw_only=True)
class Curve:
    """One labeled line of a figure.

    Attributes:
        x, y: (N,) in SI units.
        label: Text in the legend; empty: no entry.
        role: Key of ``COLORS``, or a color.
        dashed: Whether the line is dashed.
        points: Draw the samples as dots, too.
    """

    x: Array
    y: Array
    label: str = ""
    role: str = "measured"
    dashed: bool = False
    points: bool = False

    @property
    def color(self) -> str:
        return COLORS.get(self.role, self.role)


def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = 9.6, height: float = 3.4, **kwargs: Any
) -> tuple[Figure, Any]:
    """A figure and its axes (an array if there are several), in the house style."""
    figure_module = optional("matplotlib.figure", purpose="a figure")
    figure = figure_module.Figure(figsize=(width, height), layout="constrained")
    figure.set_facecolor("none")
    axes = figure.subplots(rows, columns, **kwargs)
    for ax in np.atleast_1d(np.asarray(axes, dtype=object)).flat:
        style(ax)
    return figure, axes


def trajectories(panels: Sequence[tuple[str, Sequence[Curve]]], *, ylabel: str) -> Figure:
    """Curves over time since release [s], one panel per trial, millimeters."""
    figure, axes = new_figure(
        len(panels), 1, height=2.5 * len(panels) + 0.4, sharex=True, squeeze=False
    )
    for ax, (title, curves) in zip(axes[:, 0], panels, strict=True):
        for curve in curves:
            _draw(ax, curve, scale=1e3)
        ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
        ax.set_ylabel(ylabel, color=SOFT)
        _legend(ax, curves)
    axes[-1, 0].set_xlabel("time since release [s]", color=SOFT)
    return figure


def spectra(
    panels: Sequence[tuple[str, Sequence[Curve]]], *, max_Hz: float, floor_m: float
) -> Figure:
    """Amplitude spectra [mm] over frequency [Hz], logarithmic, one panel per case."""
    figure, axes = new_figure(1, len(panels), height=3.4, sharey=True, squeeze=False)
    for ax, (title, curves) in zip(axes[0], panels, strict=True):
        for curve in curves:
            _draw(ax, curve, scale=1e3)
        ax.set_yscale("log")
        ax.set_xlim(0.0, max_Hz)
        ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
        ax.set_xlabel("frequency [Hz]", color=SOFT)
        _legend(ax, curves, columns=1)
    axes[0, 0].set_ylim(bottom=floor_m * 1e3)  # last: a limit set early stops the autoscale
    axes[0, 0].set_ylabel("amplitude [mm]", color=SOFT)
    return figure


def decay_envelopes(panels: Sequence[tuple[str, Sequence[Curve]]]) -> Figure:
    """Swing heights [mm] over time, logarithmic: a constant damping ratio is a straight line."""
    figure, axes = new_figure(1, len(panels), height=3.4, sharey=True, squeeze=False)
    for ax, (title, curves) in zip(axes[0], panels, strict=True):
        for curve in curves:
            _draw(ax, curve, scale=1e3)
        ax.set_yscale("log")
        ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
        ax.set_xlabel("time since release [s]", color=SOFT)
        _legend(ax, curves, columns=1)
    axes[0, 0].set_ylabel("swing from turn to turn [mm]", color=SOFT)
    return figure


def residuals(
    panels: Sequence[tuple[str, Sequence[Curve], Curve | None]], *, ylabel: str
) -> Figure:
    """Simulation minus measurement over time [mm], over the band that repeats span.

    Args:
        panels: (title, curves, floor): ``floor.y`` >= 0 is half the height of the grey band.
        ylabel: Label of the vertical axis of every panel.
    """
    figure, axes = new_figure(
        len(panels), 1, height=1.9 * len(panels) + 0.5, sharex=True, squeeze=False
    )
    for ax, (title, curves, floor) in zip(axes[:, 0], panels, strict=True):
        if floor is not None:
            ax.fill_between(
                floor.x, -1e3 * floor.y, 1e3 * floor.y, color=LINE, lw=0, label=floor.label
            )
        for curve in curves:
            _draw(ax, curve, scale=1e3)
        ax.axhline(0.0, color=SOFT, lw=0.6)
        ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
        ax.set_ylabel(ylabel, color=SOFT)
        _legend(ax, [*curves, *([floor] if floor is not None else [])])
    axes[-1, 0].set_xlabel("time since release [s]", color=SOFT)
    return figure


def bars(
    groups: Sequence[str],
    series: Sequence[tuple[str, Sequence[float], str]],
    *,
    ylabel: str,
    reference: Sequence[float] | None = None,
    reference_label: str = "",
    log: bool = False,
) -> Figure:
    """Grouped bars with values on top; ``reference`` draws a level across each group.

    Args:
        groups: Names of the groups on the axis.
        series: (label, one value per group, role or color); NaN leaves a gap.
        log: Whether the axis of values is logarithmic.
    """
    figure, ax = new_figure(height=3.4)
    width = 0.8 / max(len(series), 1)
    at = np.arange(len(groups))
    for i, (label, values, role) in enumerate(series):
        x = at + (i - (len(series) - 1) / 2) * width
        drawn = ax.bar(x, values, width * 0.92, label=label, color=COLORS.get(role, role))
        texts = ["" if np.isnan(v) else f"{v:.2g}" for v in values]
        ax.bar_label(drawn, texts, padding=2, fontsize=7.5, color=SOFT)
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
    ax.legend(
        frameon=False, fontsize=8.5, labelcolor=INK, ncols=4, loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
    )  # fmt: skip
    return figure


def data_uri(figure: Figure, *, png: bool = False, dpi: int = 160) -> str:
    """The figure as a data URI: SVG (sharp, its ids kept apart from other figures'), or PNG."""
    backend = optional(
        "matplotlib.backends.backend_agg" if png else "matplotlib.backends.backend_svg",
        purpose="a figure",
    )
    buffer = io.BytesIO()
    if png:
        figure.set_dpi(dpi)
        backend.FigureCanvasAgg(figure).print_png(buffer)
    else:
        backend.FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    return uri_of(buffer.getvalue(), "png" if png else "svg+xml")


def uri_of(content: bytes, kind: str) -> str:
    """A picture's file as a data URI.

    Args:
        content: Content of the file.
        kind: Its kind: "png", "svg+xml".
    """
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def style(ax: Axes) -> None:
    """Spines, ticks and grid as all figures have them."""
    ax.set_facecolor("none")
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color(LINE)
    ax.tick_params(colors=SOFT, labelsize=9, length=3)
    ax.grid(True, color=LINE, lw=0.5, alpha=0.7)
    ax.set_axisbelow(True)


def _draw(ax: Axes, curve: Curve, *, scale: float) -> None:
    ax.plot(
        curve.x,
        scale * np.asarray(curve.y),
        color=curve.color,
        lw=1.3,
        ls="--" if curve.dashed else "-",
        marker="o" if curve.points else None,
        ms=2.6,
        label=curve.label or "_",
    )


def _legend(ax: Axes, curves: Sequence[Curve], columns: int = 4) -> None:
    named = [curve for curve in curves if curve.label]
    if named:
        ax.legend(frameon=False, fontsize=8.5, ncols=min(len(named), columns), labelcolor=INK)
