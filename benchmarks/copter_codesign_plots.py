"""Figure and tables of the co-design benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plot_style import legend_below, new_figure, save, style

COLORS = ("#111111", "#c2410c", "#1d4ed8", "#60a5fa", "#15803d", "#86efac", "#9333ea")
# Thesis Table 3.1: size [mm], weight, payload, overall [g], angle [deg]
PUBLISHED = {
    "flat": ([750, 420], 2322, 1047, 3369, 0.0),
    "optimized": ([650, 670], 2353, 1392, 3745, 10.6),
}

Cases = dict[str, dict[str, Any]]


def draw(cases: Cases, path: Path) -> None:
    """Eq. 3.9 of the first start against iterations and against seconds, a column per case."""
    figure = new_figure(4.0 * max(len(cases), 1), 6.4)
    axes = figure.subplots(2, max(len(cases), 1), squeeze=False)
    for column, (case, methods) in enumerate(cases.items()):
        for color, (method, runs) in zip(COLORS, methods.items(), strict=False):
            if not runs or "failed" in runs[0]:
                continue
            first = runs[0]
            # the joint solve keeps another problem's constraints: its end alone can be compared
            if first["hard_curve"]:
                if np.isfinite(first["hard"]):
                    for row in (0, 1):
                        axes[row, column].axhline(
                            first["hard"],
                            color=color,
                            linestyle=":",
                            linewidth=1.2,
                            label="joint, hard hover",
                        )
                continue
            dash = "--" if "published" in method else "-"
            steps = range(len(first["curve"]))
            look = {"color": color, "linestyle": dash, "linewidth": 1.4, "label": method}
            axes[0, column].plot(steps, first["curve"], **look)
            axes[1, column].plot(np.maximum(first["times"], 1e-3), first["curve"], **look)
        style(axes[0, column], case, "iterations", "eq. 3.9" if column == 0 else "")
        style(axes[1, column], "", "seconds", "eq. 3.9" if column == 0 else "")
        axes[0, column].set_xscale("symlog", linthresh=10)
        axes[1, column].set_xscale("log")
        low, high = _range(methods)
        for row in (0, 1):
            axes[row, column].set_ylim(low, high)
    legend_below(figure, list(axes.ravel()), 4)
    save(figure, path)


def _range(methods: dict[str, Any]) -> tuple[float, float]:
    """From below the least value to where the slowest method starts from after one step."""
    curves = [
        r[0]["curve"] for r in methods.values() if r and "curve" in r[0] and not r[0]["hard_curve"]
    ]
    ends = [min(curve) for curve in curves] or [0.0]
    tops = [curve[0] for curve in curves] or [1.0]
    low, high = min(ends), max(tops)
    return low - 0.05 * (high - low + 1e-3), high + 0.1 * (high - low + 1e-3)


def tables(cases: Cases, twins: dict[str, Any] | None) -> str:
    """The report in Markdown."""
    lines = ["# Co-design of multicopters", ""]
    if twins:
        lines += [
            "## Flat pentacopter and its payload-optimized twin (thesis Table 3.1)",
            "",
            "| | size x, y [mm] | weight [g] | max payload [g] | max overall [g] | gain "
            "| angle [deg] | gap to bound |",
            "|---|---|---|---|---|---|---|---|",
        ]
        base = twins["flat"]["overall"]
        for name, row in twins.items():
            size = " x ".join(f"{x:.0f}" for x in row["size"])
            gain = 100.0 * (row["overall"] / base - 1.0)
            lines.append(
                f"| {name} | {size} | {row['weight']:.0f} | {row['payload']:.0f} | "
                f"{row['overall']:.0f} | {gain:+.1f} % | {row['angle']:.1f} "
                f"| {100 * row['gap']:.2g} % |"
            )
        for name, (extent, weight, payload, overall, angle) in PUBLISHED.items():
            gain = 100.0 * (overall / PUBLISHED["flat"][3] - 1.0)
            lines.append(
                f"| thesis, measured, {name} | {extent[0]} x {extent[1]} | {weight} | {payload} | "
                f"{overall} | {gain:+.1f} % | {angle} | |"
            )
        lines += ["", "The thesis predicts +15.8 % and measured +11.1 %.", ""]
    for case, methods in cases.items():
        lines += [
            f"## {case}",
            "",
            "| method | hover objective: best | median | worst | no hover | eq. 3.9: median "
            "| CPU s: median | iterations |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for method, runs in methods.items():
            lines.append(f"| {method} | {_row(runs)} |")
        lines.append("")
    return "\n".join(lines)


def _row(runs: list[dict[str, Any]] | None) -> str:
    done = [r for r in runs or [] if "failed" not in r]
    if not done:
        return " | ".join(["failed" if runs else "not run"] + [""] * 6)
    # JSON has no infinity
    hard = [_number(r["hard"]) for r in done]
    hovers = [h for h in hard if np.isfinite(h)]
    best = (
        [f"{round(float(f(hovers)), 4) + 0.0:.4f}" for f in (np.min, np.median, np.max)]
        if hovers
        else ["-"] * 3
    )
    soft = "-" if done[0]["hard_curve"] else f"{np.median([r['curve'][-1] for r in done]):.4f}"
    cpu, its = np.median([r["cpu"] for r in done]), np.median([r["iterations"] for r in done])
    return " | ".join(
        [*best, f"{len(hard) - len(hovers)} of {len(runs or [])}", soft, f"{cpu:.2g}", f"{its:.0f}"]
    )


def _number(value: Any) -> float:
    return float("inf") if value is None else float(value)
