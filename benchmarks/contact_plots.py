"""The figures of benchmarks/contact.py, each as PNG and SVG."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.contact_scenes import VARIANTS
from benchmarks.plot_style import (
    legend_below,
    new_figure,
    number_in_steps_of_1_2_5,
    save,
    select,
    style,
)
from benchmarks.soft_plots import tolerance_axis
from diffsim.viz.figures import SOFT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = {
    "auto": "#1d2433",
    "newton_pcg": "#0b6e75",
    "uncached": "#6fb3b8",
    "newton_cholesky": "#b08a00",
    "newton_jacobi": "#c2571a",
}
MARKERS = {"newton_pcg": "o", "uncached": "v", "newton_cholesky": "D", "newton_jacobi": "^"}
LABELS = {
    "auto": "auto (default)",
    "newton_pcg": "constant factor",
    "uncached": "constant factor, columns not kept",
    "newton_cholesky": "Newton, Cholesky",
    "newton_jacobi": "Newton, CG with Jacobi",
}


def draw_figures(results: dict[str, Any], out: Path) -> list[str]:
    """Draw what the results allow; returns the names, without suffix, of the files written."""
    drawings: dict[str, tuple[Callable[[dict[str, Any]], Figure], str]] = {
        "rolling": (rolling, "rows"),
        "napkin": (napkin, "cases"),
    }
    names = []
    for name, (draw, needed) in drawings.items():
        if not results.get(name, {}).get(needed):
            continue
        save(draw(results[name]), out / name)
        names.append(name)
    return names


def line_of(method: str) -> dict[str, Any]:
    """Line style of a solver; auto is drawn wide and pale, under the one it stands for."""
    if method == "auto":
        return {"color": COLORS[method], "linewidth": 6, "alpha": 0.22, "zorder": 1}
    style = {"color": COLORS[method], "marker": MARKERS[method]}
    return {**style, "linewidth": 1.5, "markersize": 4}


def rolling(stage: dict[str, Any]) -> Figure:
    """Times, loss and gradient over tolerance, as in fig. 4-5."""
    figure = new_figure(11.0, 7.2)
    grid = figure.add_gridspec(2, 6)
    times = [figure.add_subplot(grid[0, 2 * k : 2 * k + 2]) for k in range(3)]
    values = [figure.add_subplot(grid[1, 3 * k : 3 * k + 3]) for k in range(2)]
    phases = (("net", "Forward + backward"), ("forward", "Forward"), ("backward", "Backward"))
    for ax, (phase, title) in zip(times, phases, strict=True):
        style(ax, title, "tolerance", "CPU time [s]" if phase == "net" else "")
        for method in VARIANTS:
            found = select(stage["rows"], method=method)
            ax.plot(
                [r["rtol"] for r in found],
                [r[f"{phase}_cpu_s"]["median"] for r in found],
                label=LABELS[method],
                **line_of(method),
            )
        tolerance_axis(ax)
        ax.set_ylim(bottom=0)
    reference = stage["reference"]
    for ax, name, title in zip(
        values, ("loss", "grad_norm"), ("Loss", "Norm of the gradient"), strict=True
    ):
        style(ax, title, "tolerance")
        ax.axhline(reference[name], color=SOFT, linewidth=0.8, linestyle=":")
        for method in VARIANTS:
            found = select(stage["rows"], method=method)
            ax.plot([r["rtol"] for r in found], [r[name] for r in found], **line_of(method))
        tolerance_axis(ax)
    values[1].set_yscale("log")  # one contact decided otherwise can change it a thousandfold
    legend_below(figure, times, 5)
    return figure


def napkin(stage: dict[str, Any]) -> Figure:
    """Time per step over the share of nodes that may touch, one panel per mesh."""
    cases = [c for c in stage["cases"] if c["friction"] is None]
    widths = sorted({c["cells"] for c in cases})
    figure = new_figure(2.75 * max(len(widths), 2), 3.9)
    axes = np.atleast_1d(figure.subplots(1, len(widths)))
    for ax, width in zip(axes, widths, strict=True):
        own = sorted((c for c in cases if c["cells"] == width), key=lambda c: c["reach"])
        title = f"{width} x {width} x 1: {own[0]['num_dof']:,} DoF"
        style(ax, title, "nodes that may touch [%]", "CPU time per step [ms]" * (ax is axes[0]))
        for method in VARIANTS:
            found = [(c["candidates"], select(c["rows"], method=method)) for c in own]
            ax.plot(
                [100 * share for share, rows in found if rows],
                [1e3 * rows[0]["step_cpu_s"] for _, rows in found if rows],
                label=LABELS[method],
                **line_of(method),
            )
        ax.set_yscale("log")
        number_in_steps_of_1_2_5(ax.yaxis)
        ax.set_xlim(0, 55)
    legend_below(figure, list(axes), 5)
    return figure
