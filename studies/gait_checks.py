"""Is an optimized gait real? Finer time steps, tighter tolerance, differences, and a line.

Takes the optimum that ``benchmarks.applications`` (or the script itself) has on record and prints:
how far it comes with the time step halved, with cells of half the edge, and with a tolerance 100
times tighter; the gradient beside central differences of several sizes; and the loss along the
gradient. Some 30 simulations: minutes.

    python -m studies.gait_checks quadruped --record runs/table44/quadruped
    python -m studies.gait_checks quadruped --at 0.55 0.4 9 --checks steps
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch

from labs.machine import machine
from diffsim.applications import Application, evaluate, solver_options
from diffsim.applications.minimize import log_of
from diffsim.applications.table import OURS, load
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic

NAMES = ("torus", "quadruped", "cow")
CHECKS = ("steps", "mesh", "tolerance", "gradient", "line")
DIFFERENCES = (1e-3, 1e-5, 1e-7)  # half widths, in parameters from 0 to 1
LINE = np.linspace(-0.02, 0.02, 9)  # the same
DIRECTIONS = 2


def build(
    name: str, rtol: float, *, refine: int = 1, cells: int = 1, quick: bool = False
) -> Application:
    """An application of ours at a tolerance, its time step and the edges of its cells divided."""
    return load(name).build(solver_options(OURS, rtol=rtol), quick, refine, cells)


def best_of(application: Application, folder: Path) -> np.ndarray:
    """Parameters of the smallest loss that was evaluated with its gradient, of those on record."""
    path = folder / f"{OURS}.jsonl"
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} does not exist; make it with python -m benchmarks.applications --out "
            f"{folder.parent}, or give parameters with --at"
        )
    made = log_of(application, path)["evaluations"]
    best = min((e for e in made if not e["failure"]), key=lambda e: e["value"])
    return application.parameters.values(np.array(best["x"]))


def travel(application: Application, values: np.ndarray) -> dict[str, float]:
    """What the motion means, by name with unit."""
    return dict(application.numbers(values, application.motion(values)))


def slope_along(application: Application, values: np.ndarray, way: np.ndarray, h: float) -> float:
    """Central difference of the loss along ``way`` (in parameters from 0 to 1)."""
    span = application.parameters.upper - application.parameters.lower
    up, down = (
        evaluate(application, values + sign * h * way * span, gradient=False).loss
        for sign in (1.0, -1.0)
    )
    return (up - down) / (2.0 * h)


def gradient_rows(application: Application, values: np.ndarray) -> list[dict[str, Any]]:
    """The adjoint's slope along the gradient and random ways, beside differences."""
    span = application.parameters.upper - application.parameters.lower
    gradient = np.array(evaluate(application, values).gradient) * span
    rng = np.random.default_rng(0)
    ways = [gradient, *rng.standard_normal((DIRECTIONS - 1, len(span)))]
    rows = []
    for k, way in enumerate(ways):
        way = way / np.linalg.norm(way)
        differences = {f"{h:g}": slope_along(application, values, way, h) for h in DIFFERENCES}
        name = "gradient" if k == 0 else f"random {k}"
        rows.append({"along": name, "adjoint": float(gradient @ way), "differences": differences})
        print(rows[-1], flush=True)
    return rows


def line_rows(application: Application, values: np.ndarray) -> list[dict[str, float]]:
    """The loss along the gradient at distances ``LINE``."""
    span = application.parameters.upper - application.parameters.lower
    gradient = np.array(evaluate(application, values).gradient) * span
    way = gradient / np.linalg.norm(gradient)
    rows = []
    for s in LINE:
        at = evaluate(application, values + s * way * span, gradient=False)
        rows.append({"distance": float(s), "loss": at.loss})
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Run the checks, print them and keep them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", choices=NAMES)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--record", type=Path, help="folder of the application's records")
    where.add_argument("--at", type=float, nargs="+", help="parameters, in their own units")
    parser.add_argument("--checks", nargs="+", choices=CHECKS, default=CHECKS)
    parser.add_argument("--refine", type=int, nargs="+", default=[2], help="time steps out of one")
    parser.add_argument("--quick", action="store_true", help="the coarse version")
    parser.add_argument("--out", type=Path, help="default: runs/gait_checks/NAME.json")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rtol = load(args.name).RTOL
    usual = build(args.name, rtol, quick=args.quick)
    values = best_of(usual, args.record) if args.record else np.array(args.at)
    out: dict[str, Any] = {"machine": machine(), "values": values.tolist(), "rtol": rtol}
    out["as optimized"] = travel(usual, values)
    print("as optimized", out["as optimized"], flush=True)
    if "tolerance" in args.checks:
        out["tolerance / 100"] = travel(build(args.name, rtol / 100, quick=args.quick), values)
        print("tolerance / 100", out["tolerance / 100"], flush=True)
    for refine in args.refine if "steps" in args.checks else ():
        name = f"time step / {refine}"
        finer = build(args.name, rtol, refine=refine, quick=args.quick)
        out[name] = travel(finer, values)
        print(name, out[name], flush=True)
    if "mesh" in args.checks:
        out["cells / 2"] = travel(build(args.name, rtol, cells=2, quick=args.quick), values)
        print("cells / 2", out["cells / 2"], flush=True)
    tight = build(args.name, min(rtol, 1e-8), quick=args.quick)
    if "gradient" in args.checks:
        out["gradient"] = gradient_rows(tight, values)
    if "line" in args.checks:
        out["line"] = line_rows(tight, values)
    write_json_atomic(args.out or Path(f"runs/gait_checks/{args.name}.json"), out)


if __name__ == "__main__":
    with interruptible():
        main()
