"""The figures of benchmarks/soft.py, each as PNG and SVG; stages ``cantilever``, ``scaling``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.plot_style import (
    Rows,
    legend_below,
    new_figure,
    number_in_steps_of_1_2_5,
    save,
    select,
    style,
)
from benchmarks.soft_explicit import COMPARED
from benchmarks.soft_plots_studies import accuracy, compared, explicit
from benchmarks.soft_scaling import measured
from diffsim.viz.figures import INK, SOFT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {
    "auto": "#1d2433",
    "newton_pcg": "#0b6e75",
    "quasi_newton": "#7a4fa3",
    "newton_jacobi": "#c2571a",
    "newton_cholesky": "#b08a00",
}
MARKERS = {"newton_pcg": "o", "quasi_newton": "s", "newton_jacobi": "^", "newton_cholesky": "D"}
LABELS = {
    "auto": "auto (default)",
    "newton_pcg": "Newton, CG on constant factor",
    "quasi_newton": "L-BFGS on constant factor",
    "newton_jacobi": "Newton, CG with Jacobi",
    "newton_cholesky": "Newton, Cholesky",
}


def draw_figures(results: dict[str, Any], out: Path) -> list[str]:
    """Draw what the results allow; returns the names, without suffix, of the files written."""
    drawings: dict[str, tuple[Callable[[dict[str, Any]], Figure], Callable[[Any], bool]]] = {
        "cantilever": (cantilever, lambda stage: bool(stage["rows"])),
        "scaling": (scaling, lambda stage: bool(measured(stage["rows"]))),
        "explicit": (explicit, lambda stage: len(compared(stage)) == len(COMPARED)),
        "accuracy": (accuracy, lambda stage: bool(stage["rows"])),
    }
    names = []
    for name, (draw, enough) in drawings.items():
        if name not in results or not enough(results[name]):
            continue
        save(draw(results[name]), out / name)
        names.append(name)
    return names


def line_of(method: str, **more: Any) -> dict[str, Any]:
    """Line style of a method; auto is drawn wide and pale, under the method it stands for."""
    color = COLORS[method]
    if method == "auto":
        return {"color": color, "linewidth": 5, "alpha": 0.22, "zorder": 1, **more}
    return {"color": color, "linewidth": 1.5, "marker": MARKERS[method], "markersize": 4, **more}


def cantilever(stage: dict[str, Any]) -> Figure:
    """Times and errors over tolerance, as in fig. 4-4."""
    figure = new_figure(11.0, 7.2)
    grid = figure.add_gridspec(2, 6)
    times = [figure.add_subplot(grid[0, 2 * k : 2 * k + 2]) for k in range(3)]
    errors = [figure.add_subplot(grid[1, 3 * k : 3 * k + 3]) for k in range(2)]
    rows = stage["rows"]
    threads = sorted({r["threads"] for r in rows})
    methods = [m for m in COLORS if any(r["method"] == m for r in rows)]
    phases = (("net", "Forward + backward"), ("forward", "Forward"), ("backward", "Backward"))
    for ax, (phase, title) in zip(times, phases, strict=True):
        style(ax, title, "tolerance", "time [s]" if phase == "net" else "")
        for method in methods:
            for count in threads:
                found = select(rows, method=method, threads=count)
                x = [r["rtol"] for r in found]
                # One thread's own time does not see the neighbors; of several the wall's counts.
                clock = "cpu" if count == 1 else "wall"
                spreads = [r[f"{phase}_{clock}_s"] for r in found]
                dash, label = ("-", LABELS[method]) if count == threads[0] else ("--", None)
                ax.plot(x, [s["median"] for s in spreads], dash, label=label, **line_of(method))
                ax.fill_between(
                    x,
                    [s["q1"] for s in spreads],
                    [s["q3"] for s in spreads],
                    color=COLORS[method],
                    alpha=0.12,
                    linewidth=0,
                )
        tolerance_axis(ax)
        ax.set_ylim(bottom=0)
    for ax, name, title in zip(
        errors,
        ("loss_error", "grad_error"),
        ("Relative error of the loss", "Relative error of the gradient"),
        strict=True,
    ):
        style(
            ax,
            title,
            "tolerance",
            f"against Newton-Cholesky at {stage['reference']['rtol']:.0e}"
            if name == "loss_error"
            else "",
        )
        for method in methods:
            found = select(rows, method=method, threads=threads[0])
            ax.plot(
                [r["rtol"] for r in found], [max(r[name], 1e-14) for r in found], **line_of(method)
            )
        tolerance_axis(ax)
        ax.set_yscale("log")
    for count in threads if len(threads) > 1 else ():
        dash = "-" if count == threads[0] else "--"
        label = f"{count} thread" + "s" * (count > 1)
        times[0].plot([], [], dash, color=SOFT, linewidth=1.5, label=label)
    legend_below(figure, times, 4)
    return figure


def tolerance_axis(ax: Axes) -> None:
    """Logarithmic, tight tolerances to the right; the thesis's default of 1e-4 is marked."""
    ax.set_xscale("log")
    ax.invert_xaxis()
    ax.axvline(1e-4, color=SOFT, linewidth=0.8, linestyle=":")


def scaling(stage: dict[str, Any]) -> Figure:
    """Step time, memory and single operations over degrees of freedom."""
    figure = new_figure(11.0, 8.0)
    axes = figure.subplots(2, 2)
    rows = measured(stage["rows"])
    methods = [m for m in COLORS if any(r["method"] == m for r in rows)]
    panels = (
        (axes[0, 0], "Forward", "CPU time per step [s]", lambda r: r["forward_cpu_s"]["median"]),
        (
            axes[0, 1],
            "Backward",
            "CPU time per step [s]",
            lambda r: r["backward_cpu_s"]["median"],
        ),
        (
            axes[1, 0],
            "Peak memory",
            "above the imported package [GiB]",
            lambda r: r["memory_peak_B"] / 2**30,
        ),
    )
    for ax, title, ylabel, value in panels:
        style(ax, title, "degrees of freedom", ylabel)
        for method in methods:
            for kind, dash in (("hex", "-"), ("tet", "--")):
                found = select(rows, method=method, kind=kind)
                if found:
                    ax.plot(
                        [r["num_dof"] for r in found],
                        [value(r) for r in found],
                        dash,
                        label=LABELS[method] if kind == "hex" else None,
                        **line_of(method),
                    )
        size_axes(ax)
        linear_guide(ax)
    operations(axes[1, 1], [r for r in stage["operations"] if "failed" not in r])
    for dash, label in (("-", "hexahedra"), ("--", "tetrahedra")):
        axes[0, 0].plot([], [], dash, color=SOFT, linewidth=1.5, label=label)
    legend_below(figure, axes.flat[:3], 4)
    return figure


def size_axes(ax: Axes) -> None:
    """Logarithmic axes; sizes are numbered in steps of 1, 2, 5."""
    ax.set_xscale("log")
    ax.set_yscale("log")
    number_in_steps_of_1_2_5(ax.xaxis)


def linear_guide(ax: Axes) -> None:
    """A dotted line of slope one through the lower left of the data."""
    low, high = ax.get_xlim()
    bottom, top = ax.get_ylim()
    x = np.array([low, high])
    ax.plot(x, bottom * x / low, ":", color=SOFT, linewidth=1.0, label="linear")
    ax.set_xlim(low, high)
    ax.set_ylim(bottom, top)


def operations(ax: Axes, rows: Rows) -> None:
    """Single operations on hexahedra."""
    style(ax, "Single operations, hexahedra", "degrees of freedom", "CPU time [s]")
    shown = (
        ("gradient_s", "elastic gradient", "#0b6e75"),
        ("hessian_product_s", "tangent + product", "#7a4fa3"),
        ("scalar_solve_s", "solve, constant factor", "#1d2433"),
        ("scalar_factor_s", "factor, constant", "#8a93a3"),
        ("block_solve_s", "solve, tangent factor", "#c2571a"),
        ("block_factor_s", "factor, tangent", "#b08a00"),
    )
    for name, label, color in shown:
        found = [r for r in select(rows, kind="hex") if name in r]
        if found:
            ax.plot(
                [r["num_dof"] for r in found],
                [r[name] for r in found],
                "-o",
                label=label,
                color=color,
                linewidth=1.5,
                markersize=3.5,
            )
    size_axes(ax)
    ax.legend(frameon=False, fontsize=8, labelcolor=INK)
