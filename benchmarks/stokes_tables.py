"""The report and figure of benchmarks/stokes.py."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.plot_style import Rows, new_figure, save, style
from benchmarks.soft_tables import about
from diffsim.stokes import devices

PROTOTYPE = {"funnel": 7.1, "twister": 4.55, "switch": 2 * 20.3}
"""Seconds to factor and solve with PARDISO or CHOLMOD, one thread (design page, the slower of two
runs; the switch has two geometries)."""
LARGE = 5000
LEAST_MEMORY = 2**20
"""What less than this is shown as [byte]: small systems fit into memory that was there before."""
COLORS = {"scaling": "#0b6e75", "iterative": "#c2571a"}


def done(rows: Rows) -> Rows:
    return [row for row in rows if "failed" not in row]


def exponents(rows: Rows) -> dict[str, float]:
    """Slopes of log(time) and log(memory) over log(unknowns), least squares.

    Where three or more grids have over ``LARGE`` unknowns, smaller ones are left out: there, fixed
    costs count.
    """
    rows = done(rows)
    large = [row for row in rows if 3 * row["num_nodes"] > LARGE]
    rows = large if len(large) > 2 else rows
    if len(rows) < 2:
        return {}
    unknowns = np.log([3.0 * row["num_nodes"] for row in rows])

    def slope(values: list[float]) -> float:
        return float(np.polyfit(unknowns, np.log(values), 1)[0])

    return {
        "forward_cpu_s": slope([row["forward_cpu_s"]["median"] for row in rows]),
        "both_cpu_s": slope([row["both_cpu_s"]["median"] for row in rows]),
        "memory_peak_B": slope([max(row["memory_peak_B"], LEAST_MEMORY) for row in rows]),
    }


def report(results: dict[str, Any], figures: Sequence[str]) -> str:
    """Tables and figures of the stages that have run."""
    lines = ["# Stokes flow: time and memory", "", *about(results["machine"])]
    lines.append(
        f"Load average at the end {results['machine']['load_average_at_end']:.2f}. Medians; every "
        "call solves a geometry of its own. Where others use the machine, CPU seconds (of all "
        "threads) are the ones to trust."
    )
    if rows := results.get("devices"):
        lines += ["", "## Devices (thesis Table 4.5)", "", *device_table(rows)]
    for stage, title in (("scaling", "Direct solver"), ("iterative", "Iterative solver")):
        if rows := results.get(stage):
            lines += ["", f"## {title} over the grid", "", *scaling_table(rows)]
    lines += [f"\n![{name}]({name}.png)" for name in figures]
    return "\n".join(lines) + "\n"


def device_table(rows: Rows) -> list[str]:
    """Seconds per call, and how many of them the thesis's call takes."""
    lines = [
        "Thesis: wall seconds of loss and gradient on one Xeon E7-4830 v4 (2 GHz). Design page: "
        "factor and solve of a prototype with PARDISO or CHOLMOD, one thread.",
        "",
        "| device | cells | unknowns | threads | loss s (CPU) | loss and gradient s (CPU) "
        "| factor GFlop/s | peak GiB | design page s | thesis s | thesis / CPU s |",
        "|---" * 11 + "|",
    ]
    for row in rows:
        name = ", ".join([row["name"], *row["options"].values()])
        if "failed" in row:
            lines.append(f"| {name} | | | {row['threads']} | {row['failed']} |" + " |" * 6)
            continue
        full = row["resolution"] == 1.0
        thesis = devices.make(row["name"], 0.25, **row["options"]).reference["seconds"]
        ours = row["both_cpu_s"]["median"]  # of all threads: no smaller than the wall's when quiet
        rate = f"{row['factor_gflops']:.1f}" if "factor_gflops" in row else "-"  # iterated
        lines.append(
            f"| {name} | {' x '.join(map(str, row['shape']))} "
            f"| {len(row['shape']) * row['num_nodes']:,} | {row['threads']} "
            f"| {times(row, 'forward')} | {times(row, 'both')} | {rate} "
            f"| {row['memory_peak_B'] / 2**30:.2f} "
            f"| {PROTOTYPE.get(row['name'], '') if full else ''} "
            f"| {thesis if full else ''} | {f'{thesis / ours:.1f}' if full else ''} |"
        )
    return lines


def scaling_table(rows: Rows) -> list[str]:
    lines = [
        "| cells | unknowns | threads | loss s (CPU) | loss and gradient s (CPU) | peak GiB |",
        "|---" * 6 + "|",
    ]
    for row in rows:
        if "failed" in row:
            lines.append(f"| {row.get('cells', '')} | | | {row['failed']} | | |")
            continue
        lines.append(
            f"| {' x '.join(map(str, row['shape']))} | {3 * row['num_nodes']:,} | {row['threads']} "
            f"| {times(row, 'forward')} | {times(row, 'both')} "
            f"| {row['memory_peak_B'] / 2**30:.2f} |"
        )
    if found := exponents(rows):
        lines += [
            "",
            f"Exponents of unknowns (of grids above {LARGE:,}, where there are three): loss "
            f"{found['forward_cpu_s']:.2f}, loss and gradient {found['both_cpu_s']:.2f} (CPU "
            f"time), peak memory {found['memory_peak_B']:.2f}.",
        ]
    return lines


def times(row: dict[str, Any], what: str) -> str:
    wall, cpu = (row[f"{what}_{kind}_s"]["median"] for kind in ("wall", "cpu"))
    return f"{wall:.3g} ({cpu:.3g})"


def draw_figures(results: dict[str, Any], out: Path) -> list[str]:
    """Time and memory over unknowns, where at least two grids were measured."""
    stages = [stage for stage in COLORS if len(done(results.get(stage, []))) > 1]
    if not stages:
        return []
    figure = new_figure(8.0, 3.4)
    left, right = figure.subplots(1, 2)
    style(left, "Loss and gradient", "unknowns", "CPU seconds")
    style(right, "Peak memory", "unknowns", "GiB")
    for stage in stages:
        rows = done(results[stage])
        unknowns = [3 * row["num_nodes"] for row in rows]
        memory = [row["memory_peak_B"] for row in rows]
        slopes = exponents(rows)
        for ax, values, name in (
            (left, [row["both_cpu_s"]["median"] for row in rows], "both_cpu_s"),
            (right, [max(b, LEAST_MEMORY) / 2**30 for b in memory], "memory_peak_B"),
        ):
            solver = "direct" if stage == "scaling" else "iterative"
            label = f"{solver}, exponent {slopes[name]:.2f}"
            ax.loglog(unknowns, values, "o-", color=COLORS[stage], markersize=4, label=label)
    for ax in (left, right):
        ax.legend(frameon=False, fontsize=8)
    save(figure, out / "scaling")
    return ["scaling"]
