"""Accuracy of both formulations of Stokes flow on exact solutions in embedded geometry.

python -m benchmarks.stokes_accuracy                 # 16 to 128 cells, about a minute
python -m benchmarks.stokes_accuracy --cells 16 32   # quick

The published formulation is run at several Poisson's ratios, as in thesis Fig. 4-27: below 0.5 the
flow is compressible, near 0.5 it locks. Written to ``--out``: report.md with the tables,
results.json with every number, accuracy.png and .svg.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from benchmarks.harness import timed
from benchmarks.plot_style import (
    Rows,
    legend_below,
    new_figure,
    number_in_steps_of_1_2_5,
    save,
    select,
    style,
)
from benchmarks.stokes_exact import Exact, all_flows
from benchmarks.thesis_stokes import ThesisFlow
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.stokes import Grid, StokesFlow
from diffsim.viz.figures import INK
from labs.machine import machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CELLS = (16, 32, 64, 128)
RATIOS = (0.45, 0.49, 0.499, 0.4999)
DEFAULT, PUBLISHED = "default", "published"
COLORS = {DEFAULT: "#0b6e75", PUBLISHED: "#c2571a"}
PROTOTYPE = {
    "pipe, no slip": (4.4e-3, 1.4e-3, 3.7e-4, 9.1e-5),
    "pipe, slip": (4.3e-3, 1.4e-3, 4.3e-4, 1.4e-4),
    "rotated channel": (1.7e-2, 4.4e-3, 1.3e-3, 4.5e-4),
    "Couette": (2.2e-3, 5.6e-4, 1.4e-4, 3.8e-5),
}
"""Errors of the design page's prototype on grids of ``CELLS`` (Nitsche 20, ghost penalty 0.1)."""
SHADES = ("#f0b27a", "#e08a3c", "#c2571a", "#7d3208", "#4a1c02")


def label(formulation: str, poissons_ratio: float | None) -> str:
    return formulation if poissons_ratio is None else f"{formulation}, nu = {poissons_ratio:g}"


def measure(
    exact: Exact, cells: int, formulation: str, poissons_ratio: float | None
) -> dict[str, Any]:
    """One solve; ``poissons_ratio`` None is nearly incompressible, as is the default."""
    grid = exact.grid(cells)

    def solve() -> Any:
        return exact.solve(make(exact, grid, formulation, poissons_ratio), grid)

    with warnings.catch_warnings():  # Couette's fluid touches no face of the box: its wall moves it
        warnings.filterwarnings("ignore", message=".*touch no inlet")
        field, seconds = timed(solve)
    return {
        "flow": exact.name,
        "label": label(formulation, poissons_ratio),
        "formulation": formulation,
        "poissons_ratio": poissons_ratio,
        "cells": cells,
        "error": exact.error(field),
        "imbalance": abs(float(field.mass_report()["imbalance"][0])),
        "divergence": float(field.stats["divergence"][0]),
        "seconds": seconds.wall,
    }


def make(
    exact: Exact, grid: Grid, formulation: str, poissons_ratio: float | None
) -> StokesFlow | ThesisFlow:
    conditions, wall = exact.conditions(), exact.wall
    if poissons_ratio is None:
        return StokesFlow(grid, conditions, wall=wall)
    if formulation == PUBLISHED:
        return ThesisFlow(grid, conditions, wall=wall, poissons_ratio=poissons_ratio)
    bulk_ratio = 2.0 * poissons_ratio / (1.0 - 2.0 * poissons_ratio)
    return StokesFlow(grid, conditions, wall=wall, bulk_ratio=bulk_ratio)


def order(rows: Rows) -> float:
    """Slope of log(error) over log(cell size) from the coarsest to the finest grid."""
    first, last = rows[0], rows[-1]
    if first["cells"] == last["cells"]:
        return math.nan
    return math.log(first["error"] / last["error"]) / math.log(last["cells"] / first["cells"])


def table(rows: Rows, flow: str) -> str:
    """Errors of one flow as markdown: a line per formulation, a column per grid."""
    mine = select(rows, flow=flow)
    cells = sorted({r["cells"] for r in mine})
    lines = [
        f"| {flow} | " + " | ".join(f"{n} cells" for n in cells) + " | order |",
        "|---" * (len(cells) + 2) + "|",
    ]
    for name in dict.fromkeys(r["label"] for r in mine):
        found = sorted(select(mine, label=name), key=lambda r: r["cells"])
        entries = [f"{r['error']:.2e}" for r in found] + [f"{order(found):.1f}"]
        lines.append(f"| {name} | " + " | ".join(entries) + " |")
    if flow in PROTOTYPE:
        known = dict(zip(CELLS, PROTOTYPE[flow], strict=True))
        entries = [f"{known[n]:.1e}" if n in known else "" for n in cells]
        lines.append("| prototype | " + " | ".join(entries) + " | |")
    return "\n".join(lines)


def draw(rows: Rows) -> Figure:
    """Errors over the grid above, over Poisson's ratio below; one column per flow."""
    flows = list(dict.fromkeys(r["flow"] for r in rows))
    ratios = sorted({r["poissons_ratio"] for r in rows if r["poissons_ratio"] is not None})
    cells = sorted({r["cells"] for r in rows})
    figure = new_figure(3.1 * len(flows), 5.8)
    grid = figure.subplots(2, len(flows), sharey=True, squeeze=False)
    for column, flow in enumerate(flows):
        ax = grid[0][column]
        style(ax, flow, "cells per side", "relative L2 error" if column == 0 else "")
        lines = [(PUBLISHED, r, s) for r, s in zip(ratios, SHADES, strict=False)]
        for formulation, ratio, shade in [*lines, (DEFAULT, None, COLORS[DEFAULT])]:
            found = select(rows, flow=flow, formulation=formulation, poissons_ratio=ratio)
            if found:
                ax.loglog(
                    [r["cells"] for r in found],
                    [r["error"] for r in found],
                    "o-",
                    color=shade,
                    markersize=4,
                    label=found[0]["label"],
                )
        ideal = select(rows, flow=flow, label=DEFAULT)
        if len(ideal) > 1:
            top = ideal[0]["error"]
            ax.loglog(cells, [top * (cells[0] / n) ** 2 for n in cells], ":", color=INK, lw=0.8)
        number_in_steps_of_1_2_5(ax.xaxis)
        ax = grid[1][column]
        style(ax, "", "1 - 2 nu (incompressible to the right)", "relative L2 error" * (not column))
        for formulation, n, line in [
            (f, *pair) for f in COLORS for pair in zip(cells, ("--", "-.", ":", "-"), strict=False)
        ]:
            found = select(rows, flow=flow, cells=n, formulation=formulation)
            found = [r for r in found if r["poissons_ratio"] is not None]
            ax.loglog(
                [1.0 - 2.0 * r["poissons_ratio"] for r in found],
                [r["error"] for r in found],
                line,
                color=COLORS[formulation],
                label=f"{formulation}, {n} cells",
            )
        ax.invert_xaxis()
    axes = [ax for row in grid for ax in row]
    legend_below(figure, axes, 5)
    return figure


def report(rows: Rows) -> str:
    flows = list(dict.fromkeys(r["flow"] for r in rows))
    worst = max((r for r in rows), key=lambda r: r["imbalance"])
    return "\n\n".join(
        [
            "# Stokes flow: accuracy on exact solutions",
            "Relative L2 error of the velocity at the nodes in the fluid; order from the coarsest "
            'to the finest grid. "published" is `benchmarks.thesis_stokes.ThesisFlow`, "default" '
            "is `StokesFlow`, also with the bulk ratio 2 nu / (1 - 2 nu) that a Poisson's "
            "ratio stands for: the same compressible flow without locking. The pipe is a quarter "
            "bend between radii 0.12 and 0.9 in the unit square with exact velocities at both "
            "ends. The prototype is the design page's, whose radii are not known.",
            *(table(rows, flow) for flow in flows),
            f"Largest volume imbalance of the box: {worst['imbalance']:.1e} ({worst['flow']}, "
            f"{worst['label']}, {worst['cells']} cells); velocities are prescribed wherever these "
            "flows cross the box, so this is the inlets' own.",
            "![errors](accuracy.png)",
            "Above: over the grid; dotted, second order. Below: over Poisson's ratio.",
        ]
    )


def run(cells: Iterable[int], ratios: Sequence[float]) -> Rows:
    rows = []
    cells = sorted(cells)
    for exact in all_flows():
        ladder = sorted(ratios)
        for formulation, ratio in [
            *((PUBLISHED, r) for r in ladder),
            *((DEFAULT, r) for r in (*ladder, None)),
        ]:
            rows += [measure(exact, n, formulation, ratio) for n in cells]
        print(table(rows, exact.name), end="\n\n", flush=True)
    return rows


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells", type=int, nargs="+", default=list(CELLS))
    parser.add_argument("--ratios", type=float, nargs="+", default=list(RATIOS))
    parser.add_argument("--out", type=Path, default=Path("runs/stokes_accuracy"))
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    rows = run(args.cells, args.ratios)
    results = {"machine": machine(), "rows": rows}
    args.out.mkdir(parents=True, exist_ok=True)
    write_json_atomic(args.out / "results.json", results)
    write_text_atomic(args.out / "report.md", report(rows) + "\n")
    save(draw(rows), args.out / "accuracy")
    return results


if __name__ == "__main__":
    with interruptible():
        main()
