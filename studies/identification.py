"""What the motions of the plant and the ball say about E and nu, and what a wrong model costs.

For each application: how far a change of log E or log nu moves the nodes (four simulations), and
what the fit makes of data by BDF2 instead of implicit Euler. ``--jump``: the ball's loss along a
line, with the thesis's sticking floor and with friction.

    python -m studies.identification --quick            # a minute
    python -m studies.identification --names bouncing_ball --out runs/identification
    python -m studies.identification --jump             # 40 CPU seconds
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from diffsim.applications import evaluate, minimize, solver_options
from diffsim.applications.identification import visibility
from diffsim.applications.table import OURS, load
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic

NAMES = ("plant", "bouncing_ball")


def seen(name: str, *, quick: bool) -> dict[str, float]:
    """RMS displacements of the nodes over the whole motion at the truth [mm]."""
    application = load(name).build(solver_options(OURS, rtol=1e-8), quick)
    found = visibility(application, application.oracle_parameters)
    along, moved = found.weak
    return {
        "10 % of E alone, mm": 1e2 * found.alone[0],
        "10 % of nu alone, mm": 1e2 * found.alone[1],
        "10 % of E, best nu, mm": 1e2 * found.together[0],
        "10 % of nu, best E, mm": 1e2 * found.together[1],
        "weak combination, log E": along[0],
        "weak combination, log nu": along[1],
        "10 % along it, mm": 1e2 * moved,
        "percent of E per mm": 100.0 * found.uncertainty(1e-3)[0],
        "percent of nu per mm": 100.0 * found.uncertainty(1e-3)[1],
    }


def other_integrator(name: str, out: Path, *, quick: bool, evaluations: int) -> dict[str, float]:
    """The fit by implicit Euler to data by BDF2."""
    module = load(name)
    application = module.build(solver_options(OURS, rtol=module.RTOL), quick, "bdf2")
    size = "quick" if quick else "full"
    found = minimize(
        application,
        max_evaluations=evaluations,
        record=out / f"{name}_bdf2_{size}.jsonl",
        progress=True,
    )
    best = np.array(found.best.values)
    return {
        "evaluations": float(len(found.evaluations)),
        **application.numbers(best, application.motion(best)),
    }


def jump() -> list[dict[str, float]]:
    """Losses of the ball's first bounce from where a fit got stuck (0) to the truth (1)."""
    rows = []
    for friction in (math.inf, 0.5):
        module = load("bouncing_ball")
        options = solver_options(OURS, rtol=module.RTOL)
        application = module.build(options, False, friction=friction).warm_up
        truth, stuck = application.oracle_parameters, np.log([2.1734e6, 0.3733])
        for part in (0.0, 0.25, 0.5, 0.75, 0.9, 1.0):
            loss = evaluate(application, stuck + part * (truth - stuck), gradient=False).loss
            rows.append({"friction": friction, "part of the way": part, "loss": loss})
            print(f"friction {friction:<5g} {part:5.2f} of the way: loss {loss:.4g}", flush=True)
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="coarse meshes, short motions")
    parser.add_argument("--names", nargs="+", choices=NAMES, default=NAMES)
    parser.add_argument("--evaluations", type=int, default=30, metavar="N")
    parser.add_argument("--no-bdf2", action="store_true", help="only what the motions show")
    parser.add_argument("--jump", action="store_true", help="only the ball's loss along a line")
    parser.add_argument("--out", type=Path, default=Path("runs/identification"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.jump:
        write_json_atomic(args.out / "jump.json", jump())
        return
    numbers: dict[str, dict[str, float]] = {}
    for name in args.names:
        numbers[name] = seen(name, quick=args.quick)
        if not args.no_bdf2:
            fit = other_integrator(name, args.out, quick=args.quick, evaluations=args.evaluations)
            numbers[name] |= {f"data by BDF2: {k}": v for k, v in fit.items()}
        for key, value in numbers[name].items():
            print(f"{name:16s}{key:44s}{value:.4g}", flush=True)
        write_json_atomic(
            args.out / f"{name}_{'quick' if args.quick else 'full'}.json", numbers[name]
        )


if __name__ == "__main__":
    with interruptible():
        main()
