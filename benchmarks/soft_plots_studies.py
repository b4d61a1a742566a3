"""Figures of the stages ``explicit`` and ``accuracy`` of benchmarks/soft.py."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.plot_style import (
    Rows,
    legend_below,
    new_figure,
    number_in_steps_of_1_2_5,
    select,
    style,
)
from benchmarks.soft_explicit import COMPARED, EXPLICIT
from diffsim.viz.figures import INK, SOFT

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {"implicit_euler": "#0b6e75", EXPLICIT: "#c2571a"}
LABELS = {"implicit_euler": "implicit Euler", EXPLICIT: "explicit"}
RATIO_COLORS = ("#b08a00", "#0b6e75", "#c2571a", "#7a4fa3")


def compared(stage: dict[str, Any]) -> Rows:
    """The landscapes that the figure shows."""
    return [r for r in stage["landscapes"] if r["integrator"] in COMPARED]


def explicit(stage: dict[str, Any], *, curves: int = 5) -> Figure:
    """Relative change of loss and gradient along random directions, as in fig. 4-3."""
    shown = compared(stage)
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
            color = COLORS[r["integrator"]]
            label = f"{LABELS[r['integrator']]}, dt = {1e3 * r['dt_s']:.2g} ms"
            few.plot(alpha, change[:curves].T, color=color, linewidth=1.1, alpha=0.85)
            mean, std = change.mean(0), change.std(0)
            all_of_them.plot(alpha, mean, color=color, linewidth=1.8, label=label)
            all_of_them.fill_between(
                alpha, mean - std, mean + std, color=color, alpha=0.22, linewidth=0
            )
    for ax in axes[1]:
        ax.set_xlabel(
            "largest change of a coordinate [% of the beam's length]", color=SOFT, fontsize=9
        )
    legend_below(figure, axes.flat, 2)
    return figure


def accuracy(stage: dict[str, Any]) -> Figure:
    """Solves per step and adjoint over the shares: volume per method, then fibers."""
    rows = [r for r in stage["rows"] if r["converged"]]
    kinds = sorted({r["kind"] for r in rows})
    studies = [
        ("VOLUME_SHARE", "newton_pcg", "Newton, CG on constant factor"),
        ("VOLUME_SHARE", "quasi_newton", "L-BFGS on constant factor"),
        ("FIBER_SHARE", None, "Muscle"),
    ]
    studies = [
        (name, method, title)
        for name, method, title in studies
        if any(r["name"] == name and method in (None, r["method"]) for r in rows)
    ]
    figure = new_figure(10.5, 3.0 * len(studies) + 0.8)
    axes = figure.subplots(len(studies), len(kinds), squeeze=False, sharey="row")
    for i, (name, method, title) in enumerate(studies):
        for k, kind in enumerate(kinds):
            found = select(rows, name=name, kind=kind)
            found = [r for r in found if method in (None, r["method"])]
            element = {"hex": "hexahedra", "tet": "tetrahedra"}[kind]
            style(axes[i, k], f"{title}, {element}", name, "solves, step + adjoint" * (k == 0))
            over_shares(axes[i, k], found)
        if method:
            axes[i, 0].set_yscale("log")
            number_in_steps_of_1_2_5(axes[i, 0].yaxis)
        else:
            axes[i, 0].set_ylim(bottom=0)
    legend_below(figure, axes.flat, 4)
    return figure


def over_shares(ax: Axes, rows: Rows) -> None:
    """One line per material (or per method, for muscles); the share in use is marked."""
    shares = sorted({r["share"] for r in rows})
    ratios = sorted({r["poissons_ratio"] for r in rows if "poissons_ratio" in r})
    lines: dict[tuple[str, str, str], Rows] = {}
    for r in rows:
        if "poissons_ratio" in r:
            color = RATIO_COLORS[ratios.index(r["poissons_ratio"])]
            dash = "-" if r["volume_weight"] == "thesis" else "--"
            label = f"ν = {r['poissons_ratio']}, {r['volume_weight']}"
        else:
            color, label = INK, f"muscle, {r['method']}"
            dash = "-" if r["method"] == "newton_pcg" else "--"
        lines.setdefault((label, color, dash), []).append(r)
    for (label, color, dash), line in lines.items():
        solves = [r["step_solves"] + r["adjoint_solves"] for r in line]
        x = [shares.index(r["share"]) for r in line]
        ax.plot(x, solves, dash, marker="o", markersize=4, color=color, label=label)
    ax.set_xticks(range(len(shares)), [f"{s:g}" for s in shares])
    for share in {r["share"] for r in rows if r["chosen"]}:
        ax.axvline(shares.index(share), color=SOFT, linewidth=0.8, linestyle=":")
