"""How near to its target does the bunny come from many first guesses, and what holds it back?

The bunny of ``examples/applications/bunny.py`` is optimized from the script's first guess and from
random throws, a few evaluations each, then from the best of them again.

    python -m studies.bunny_starts            # coarse mesh, 40 CPU seconds; --full: an hour
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from diffsim.applications import Application, Evaluation, minimize, solver_options
from diffsim.applications.table import OURS, load
from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic


def throw(application: Application, first: np.ndarray, evaluations: int) -> Evaluation:
    """The best found from one first guess."""
    begun = replace(application, parameters=replace(application.parameters, first=first))
    return minimize(begun, max_evaluations=evaluations, progress=True).best


def main() -> None:
    """Throw and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--full", action="store_true", help="the mesh of the thesis's size")
    parser.add_argument("--starts", type=int, default=8, metavar="N")
    parser.add_argument("--evaluations", type=int, default=10, metavar="N", help="of each start")
    parser.add_argument("--out", type=Path, default=Path("runs/bunny_starts"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    module = load("bunny")
    application = module.build(solver_options(OURS, rtol=module.RTOL), not args.full)
    parameters, rng = application.parameters, np.random.default_rng(0)
    firsts = [parameters.first, *(parameters.random(rng) for _ in range(args.starts - 1))]
    rows: list[dict] = []

    def report(label: str, found: Evaluation) -> Evaluation:
        at = parameters.scaled(np.array(found.values))
        held = [n for n, s in zip(parameters.names, at, strict=True) if min(s, 1.0 - s) < 1e-6]
        rows.append({"start": label, "distance_mm": 1e3 * found.loss**0.5, "at_bounds": held})
        print(f"{label:10s}{rows[-1]['distance_mm']:8.1f} mm   at bounds: {', '.join(held)}")
        write_json_atomic(args.out / "starts.json", rows)
        return found

    ends = [
        report("script's" if k == 0 else f"random {k}", throw(application, f, args.evaluations))
        for k, f in enumerate(firsts)
    ]
    best = np.array(min(ends, key=lambda e: e.loss).values)
    report("best again", throw(application, best, 2 * args.evaluations))


if __name__ == "__main__":
    with interruptible():
        main()
