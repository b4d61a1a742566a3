"""Figures of the demo's page: curves given in SI units and drawn in millimeters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from diffsim.viz.figures import COLORS, INK, LINE, SOFT, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


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


def trajectories(panels: Sequence[tuple[str, Sequence[Curve]]], *, ylabel: str) -> Figure:
    """Curves over time since release [s], one panel per trial, millimeters."""
    figure, axes = new_figure(
        len(panels), 1, height=2.5 * len(panels) + 0.4, sharex=True, squeeze=False
    )
    for ax, (title, curves) in zip(axes[:, 0], panels, strict=True):
        _draw_curves(ax, title, curves)
        ax.set_ylabel(ylabel, color=SOFT)
    axes[-1, 0].set_xlabel("time since release [s]", color=SOFT)
    return figure


def spectra(
    panels: Sequence[tuple[str, Sequence[Curve]]], *, max_Hz: float, floor_m: float
) -> Figure:
    """Amplitude spectra [mm] over frequency [Hz], logarithmic, one panel per case."""
    figure, axes = new_figure(1, len(panels), height=3.4, sharey=True, squeeze=False)
    for ax, (title, curves) in zip(axes[0], panels, strict=True):
        _draw_curves(ax, title, curves, columns=1)
        ax.set_yscale("log")
        ax.set_xlim(0.0, max_Hz)
        ax.set_xlabel("frequency [Hz]", color=SOFT)
    axes[0, 0].set_ylim(bottom=floor_m * 1e3)  # last: a limit set early stops the autoscale
    axes[0, 0].set_ylabel("amplitude [mm]", color=SOFT)
    return figure


def decay_envelopes(panels: Sequence[tuple[str, Sequence[Curve]]]) -> Figure:
    """Swing heights [mm] over time, logarithmic: a constant damping ratio is a straight line."""
    figure, axes = new_figure(1, len(panels), height=3.4, sharey=True, squeeze=False)
    for ax, (title, curves) in zip(axes[0], panels, strict=True):
        _draw_curves(ax, title, curves, columns=1)
        ax.set_yscale("log")
        ax.set_xlabel("time since release [s]", color=SOFT)
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
        ax.axhline(0.0, color=SOFT, lw=0.6)
        _draw_curves(ax, title, curves)
        ax.set_ylabel(ylabel, color=SOFT)
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


def _draw_curves(ax: Axes, title: str, curves: Sequence[Curve], columns: int = 4) -> None:
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
    named = ax.get_legend_handles_labels()[1]
    if named:
        ax.legend(frameon=False, fontsize=8.5, ncols=min(len(named), columns), labelcolor=INK)
