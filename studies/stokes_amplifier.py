"""Thesis Fig. 4-27 again: convergence of the amplifier in the cell size and in Poisson's ratio.

python -m studies.stokes_amplifier               # about a minute

Both studies of the thesis compare a formulation with itself: finer grids of the same Poisson's
ratio, and larger ratios on the same grid. The last column compares with the incompressible flow of
the default formulation on the finest grid instead, which also sees what refinement or a larger
ratio alone cannot.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.thesis_stokes import ThesisFlow
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.stokes import FlowField, Grid, Inlet, Open, StokesFlow
from diffsim.stokes.shapes import BezierCurve2d, Intersection
from labs.machine import machine

CELLS = (32, 24)
SCALES = (1, 2, 4, 8)
RATIOS = (0.45, 0.47, 0.48, 0.49, 0.495, 0.499)
INLET = (4.0, 20.0)  # between the walls on the left [cells of the coarsest grid]
LOWER = ((32.0, 10.0), (22.0, 10.0), (12.0, 10.0), (0.0, 4.0))
UPPER = ((0.0, 20.0), (12.0, 14.0), (22.0, 14.0), (32.0, 14.0))


def solve(scale: int, poissons_ratio: float | None) -> FlowField:
    """The amplifier on 32 x 24 cells times ``scale``; a box of 32 x 24 m, 1 m/s at the inlet."""
    grid = Grid(tuple(n * scale for n in CELLS), size=CELLS)
    conditions: list[Inlet | Open] = [
        Inlet("x-", where=lambda x: (x[:, 1] > INLET[0]) & (x[:, 1] < INLET[1])),
        *map(Open, grid.faces),
    ]
    curves = [torch.tensor(points, dtype=torch.float64) for points in (LOWER, UPPER)]
    shape = Intersection(*(BezierCurve2d(points, fluid="right") for points in curves))
    phi = shape(grid.nodes)
    inlet = torch.tensor([1.0, 0.0], dtype=torch.float64)
    if poissons_ratio is None:
        return StokesFlow(grid, conditions, wall="no_separation")(phi, inlet)
    flow = ThesisFlow(grid, conditions, wall="no_separation", poissons_ratio=poissons_ratio)
    return flow(phi, inlet)


def apart(found: FlowField, reference: FlowField) -> float:
    """Relative difference at the nodes of the coarsest grid in the fluid."""

    def coarse(field: FlowField) -> tuple[Tensor, Tensor]:
        step = field.grid.shape[0] // CELLS[0]
        return field.velocity[0, ::step, ::step], field.phi[::step, ::step]

    (v, phi), (wanted, _) = coarse(found), coarse(reference)
    return float((v - wanted)[phi > 0].norm() / wanted[phi > 0].norm())


def run(scales: Sequence[int], ratios: Sequence[float]) -> dict[str, Any]:
    truth = solve(max(scales), None)
    by_scale = {nu: {s: solve(s, nu) for s in scales} for nu in (ratios[0], ratios[-1])}
    refinement = [
        {
            "poissons_ratio": nu,
            "cells": fields[s].grid.shape,
            "to_finest": apart(fields[s], fields[max(scales)]),
            "to_incompressible": apart(fields[s], truth),
        }
        for nu, fields in by_scale.items()
        for s in scales
    ]
    coarse = {nu: solve(scales[0], nu) for nu in ratios}
    stiffening = [
        {
            "poissons_ratio": nu,
            "to_stiffest": apart(field, coarse[ratios[-1]]),
            "to_incompressible": apart(field, truth),
        }
        for nu, field in coarse.items()
    ]
    default = [
        {"cells": field.grid.shape, "to_finest": apart(field, truth)}
        for field in (solve(s, None) for s in scales)
    ]
    return {"refinement": refinement, "stiffening": stiffening, "default": default}


def report(results: dict[str, Any]) -> str:
    lines = [
        "# Amplifier: convergence in the cell size and in Poisson's ratio (thesis Fig. 4-27)",
        "",
        "Relative difference of velocities at the fluid nodes of the coarsest grid.",
        "",
        "| formulation | cells | to its finest grid | to the default's finest |",
        "|---|---|---|---|",
    ]
    for row in results["refinement"]:
        lines.append(
            f"| published, nu = {row['poissons_ratio']:g} | {row['cells'][0]} x {row['cells'][1]} "
            f"| {row['to_finest']:.2e} | {row['to_incompressible']:.2e} |"
        )
    for row in results["default"]:
        cells = f"{row['cells'][0]} x {row['cells'][1]}"
        lines.append(f"| default | {cells} | {row['to_finest']:.2e} | {row['to_finest']:.2e} |")
    lines += ["", "| nu, coarsest grid | to the largest nu | to the default's finest |"]
    lines += ["|---|---|---|"]
    lines += [
        f"| {row['poissons_ratio']:g} | {row['to_stiffest']:.2e} | {row['to_incompressible']:.2e} |"
        for row in results["stiffening"]
    ]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scales", type=int, nargs="+", default=list(SCALES))
    parser.add_argument("--ratios", type=float, nargs="+", default=list(RATIOS))
    parser.add_argument("--out", type=Path, default=Path("runs/stokes_amplifier"))
    args = parser.parse_args(argv)
    torch.set_num_threads(1)
    results = run(sorted(args.scales), sorted(args.ratios))
    args.out.mkdir(parents=True, exist_ok=True)
    write_json_atomic(args.out / "results.json", {"machine": machine(), **results})
    write_text_atomic(args.out / "report.md", report(results) + "\n")
    print(report(results))
    return results


if __name__ == "__main__":
    with interruptible():
        main()
