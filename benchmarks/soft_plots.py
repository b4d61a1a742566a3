"""The figures of benchmarks/soft.py, each as PNG and SVG; no pyplot, so no global state."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

from diffsim._files import write_bytes_atomic
from diffsim.viz.figures import INK, LINE, SOFT

Rows = list[dict[str, Any]]
COLOURS = {
    "auto": "#1d2433",
    "newton_pcg": "#0b6e75",
    "quasi_newton": "#7a4fa3",
    "newton_jacobi": "#c2571a",
    "newton_cholesky": "#b08a00",
    "implicit_euler": "#0b6e75",
    "bdf2": "#7a4fa3",
    "implicit_midpoint": "#b08a00",
    "semi_implicit_euler": "#c2571a",
}
MARKERS = {"newton_pcg": "o", "quasi_newton": "s", "newton_jacobi": "^", "newton_cholesky": "D"}
LABELS = {
    "auto": "auto (default)",
    "newton_pcg": "Newton, CG on constant factor",
    "quasi_newton": "L-BFGS on constant factor",
    "newton_jacobi": "Newton, CG with Jacobi",
    "newton_cholesky": "Newton, Cholesky",
    "implicit_euler": "implicit Euler",
    "bdf2": "BDF2",
    "implicit_midpoint": "implicit midpoint",
    "semi_implicit_euler": "explicit",
}


def draw_figures(results: dict[str, Any], out: Path) -> list[str]:
    """Draw what the results allow; returns the names, without suffix, of the files written."""
    drawings: dict[str, tuple[str, Callable[[dict[str, Any]], Figure]]] = {
        "cantilever": ("cantilever", cantilever),
        "scaling": ("scaling", scaling),
        "explicit": ("explicit", explicit),
        "accuracy": ("accuracy", accuracy),
    }
    names = []
    for name, (stage, draw) in drawings.items():
        if not complete(stage, results.get(stage)):
            continue
        figure = draw(results[stage])
        for suffix in ("png", "svg"):
            content = io.BytesIO()
            figure.savefig(content, format=suffix, dpi=160)
            write_bytes_atomic(out / f"{name}.{suffix}", content.getvalue())
        names.append(name)
    return names


def complete(stage: str, found: dict[str, Any] | None) -> bool:
    """Whether there is enough to draw."""
    if not found:
        return False
    return bool(found["landscapes"]) if stage == "explicit" else bool(found["rows"])


def style(ax: Axes, title: str, xlabel: str, ylabel: str = "") -> None:
    """The look of diffsim's reports."""
    ax.set_title(title, loc="left", fontsize=10, color=INK, fontweight="bold")
    ax.set_xlabel(xlabel, color=SOFT, fontsize=9)
    ax.set_ylabel(ylabel, color=SOFT, fontsize=9)
    ax.tick_params(colors=SOFT, labelsize=8)
    ax.grid(True, which="major", color=LINE, linewidth=0.6)
    ax.set_axisbelow(True)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(LINE)


def new_figure(width: float, height: float) -> Figure:
    """A white figure whose parts keep out of each other's way."""
    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def legend_below(figure: Figure, axes: Sequence[Axes], columns: int) -> None:
    """One legend for all panels: every label once."""
    entries = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )


def line_of(method: str, **more: Any) -> dict[str, Any]:
    """Line style of a method; auto is drawn wide and pale, under the method it stands for."""
    colour = COLOURS[method]
    if method == "auto":
        return {"color": colour, "linewidth": 5, "alpha": 0.22, "zorder": 1, **more}
    return {"color": colour, "linewidth": 1.5, "marker": MARKERS[method], "markersize": 4, **more}


def cantilever(stage: dict[str, Any]) -> Figure:
    """Times and errors over tolerance, as in fig. 4-4."""
    figure = new_figure(11.0, 7.2)
    grid = figure.add_gridspec(2, 6)
    times = [figure.add_subplot(grid[0, 2 * k : 2 * k + 2]) for k in range(3)]
    errors = [figure.add_subplot(grid[1, 3 * k : 3 * k + 3]) for k in range(2)]
    rows = stage["rows"]
    threads = sorted({r["threads"] for r in rows})
    methods = [m for m in COLOURS if any(r["method"] == m for r in rows)]
    phases = (("net", "Forward + backward"), ("forward", "Forward"), ("backward", "Backward"))
    for ax, (phase, title) in zip(times, phases, strict=True):
        style(ax, title, "tolerance", "wall time [s]" if phase == "net" else "")
        for method in methods:
            for count in threads:
                found = select(rows, method=method, threads=count)
                x = [r["rtol"] for r in found]
                spreads = [r[f"{phase}_wall_s"] for r in found]
                dash, label = ("-", LABELS[method]) if count == threads[0] else ("--", None)
                ax.plot(x, [s["median"] for s in spreads], dash, label=label, **line_of(method))
                ax.fill_between(
                    x,
                    [s["q1"] for s in spreads],
                    [s["q3"] for s in spreads],
                    color=COLOURS[method],
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


def select(rows: Rows, **wanted: Any) -> Rows:
    """Rows whose entries equal all of ``wanted``."""
    return [r for r in rows if all(r.get(k) == v for k, v in wanted.items())]


def scaling(stage: dict[str, Any]) -> Figure:
    """Step time, memory and single operations over degrees of freedom."""
    figure = new_figure(11.0, 8.0)
    axes = figure.subplots(2, 2)
    rows = [r for r in stage["rows"] if "skipped" not in r]
    methods = [m for m in COLOURS if any(r["method"] == m for r in rows)]
    panels = (
        (axes[0, 0], "Forward", "wall time per step [s]", lambda r: r["forward_wall_s"]["median"]),
        (
            axes[0, 1],
            "Backward",
            "wall time per step [s]",
            lambda r: r["backward_wall_s"]["median"],
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
    ax.xaxis.set_major_locator(FixedLocator([m * 10**k for k in range(2, 8) for m in (1, 2, 5)]))
    ax.xaxis.set_major_formatter(
        FuncFormatter(lambda x, _: f"{x:,.0f}" if x < 1e4 else f"{x / 1e3:,.0f}k")
    )
    ax.xaxis.set_minor_formatter(NullFormatter())


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
    style(ax, "Single operations, hexahedra", "degrees of freedom", "wall time [s]")
    shown = (
        ("gradient_s", "elastic gradient", "#0b6e75"),
        ("hessian_product_s", "tangent + product", "#7a4fa3"),
        ("scalar_solve_s", "solve, constant factor", "#1d2433"),
        ("scalar_factor_s", "factor, constant", "#8a93a3"),
        ("block_solve_s", "solve, tangent factor", "#c2571a"),
        ("block_factor_s", "factor, tangent", "#b08a00"),
    )
    for name, label, colour in shown:
        found = [r for r in select(rows, kind="hex") if name in r]
        if found:
            ax.plot(
                [r["num_dof"] for r in found],
                [r[name] for r in found],
                "-o",
                label=label,
                color=colour,
                linewidth=1.5,
                markersize=3.5,
            )
    size_axes(ax)
    ax.legend(frameon=False, fontsize=8, labelcolor=INK)


def explicit(stage: dict[str, Any], *, curves: int = 5) -> Figure:
    """Relative change of loss and gradient along random directions, as in fig. 4-3."""
    shown = [
        r
        for r in stage["landscapes"]
        if r["integrator"] in ("implicit_euler", "semi_implicit_euler")
    ]
    figure = new_figure(10.5, 6.6)
    axes = figure.subplots(2, 2, sharex=True, sharey="row")
    for row, (name, title) in enumerate((("loss", "Loss"), ("grad_norm", "Gradient norm"))):
        few, all_of_them = axes[row]
        count = len(shown[0][name])
        style(few, f"{title}, {min(curves, count)} directions", "", "change [%]")
        style(all_of_them, f"{title}, mean ± standard deviation of {count}", "")
        for r in reversed(shown):  # the explicit one behind
            values = np.array(r[name])
            change = 100 * (values / values[:, values.shape[1] // 2, None] - 1.0)
            alpha = 100 * np.array(r["alpha"])
            colour = COLOURS[r["integrator"]]
            label = f"{LABELS[r['integrator']]}, dt = {1e3 * r['dt_s']:.2g} ms"
            few.plot(alpha, change[:curves].T, color=colour, linewidth=1.1, alpha=0.85)
            mean, std = change.mean(0), change.std(0)
            all_of_them.plot(alpha, mean, color=colour, linewidth=1.8, label=label)
            all_of_them.fill_between(
                alpha, mean - std, mean + std, color=colour, alpha=0.22, linewidth=0
            )
    for ax in axes.flat:
        # Explicit gradients can grow without bound where a step is barely stable.
        ax.set_yscale("symlog", linthresh=1.0)
    for ax in axes[1]:
        ax.set_xlabel(
            "largest change of a coordinate [% of the beam's length]", color=SOFT, fontsize=9
        )
    legend_below(figure, axes.flat, 2)
    return figure


def accuracy(stage: dict[str, Any]) -> Figure:
    """Solves of newton_pcg, step + adjoint, over the share, one panel per element kind and name."""
    rows = [r for r in select(stage["rows"], method="newton_pcg") if r["converged"]]
    names = [n for n in ("VOLUME_SHARE", "FIBRE_SHARE") if select(rows, name=n)]
    kinds = sorted({r["kind"] for r in rows})
    figure = new_figure(10.5, 3.6 * len(names) + 0.5)
    axes = figure.subplots(len(names), len(kinds), squeeze=False, sharey="row")
    ratio_colours = dict(
        zip(
            sorted({r.get("poissons_ratio", 0.45) for r in rows}),
            ("#b08a00", "#0b6e75", "#c2571a", "#7a4fa3"),
            strict=False,
        )
    )
    for i, name in enumerate(names):
        both = select(rows, name=name)
        for k, kind in enumerate(kinds):
            ax = axes[i, k]
            found = select(rows, name=name, kind=kind)
            shares = sorted({r["share"] for r in found})
            unit = "solves per step + adjoint" if k == 0 else ""
            style(ax, {"hex": "Hexahedra", "tet": "Tetrahedra"}[kind], name, unit)
            for ratio, colour in ratio_colours.items():
                for weight, dash in (("thesis", "-"), ("small_strain", "--"), (None, "-")):
                    line = [
                        r
                        for r in found
                        if (r.get("volume_weight"), r.get("poissons_ratio", 0.45))
                        == (weight, ratio)
                    ]
                    if line:
                        label = f"ν = {ratio}, {weight}" if weight else "muscle, ν = 0.45"
                        ax.plot(
                            [shares.index(r["share"]) for r in line],
                            [r["step_solves"] + r["adjoint_solves"] for r in line],
                            dash,
                            marker="o",
                            markersize=4,
                            color=colour,
                            label=label,
                        )
            ax.set_xticks(range(len(shares)), [f"{s:g}" for s in shares])
            for r in found:
                if r["chosen"]:
                    ax.axvline(shares.index(r["share"]), color=SOFT, linewidth=0.8, linestyle=":")
            ax.set_ylim(0, 1.2 * max(r["step_solves"] + r["adjoint_solves"] for r in both))
            if k == 0:
                ax.legend(frameon=False, fontsize=8, labelcolor=INK)
    return figure
