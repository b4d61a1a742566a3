"""Thesis Table 4.4 of ours: forward and backward seconds, evaluations and final losses.

Every application under ``examples/applications`` is optimized by our solver and by both Newton
baselines, from the same first guess with the same criteria. Every evaluation is kept: interrupted,
the command goes on where it was.

    python -m benchmarks.applications            # hours; --quick: minutes
    python -m benchmarks.applications --names routing_tendon bunny --out runs/table44
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from diffsim.core import interruptible
from diffsim.core.files import write_json_atomic
from examples.applications import SOLVERS, table
from labs.machine import machine


def main() -> None:
    """Make the table and print it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="coarse meshes, 8 evaluations")
    parser.add_argument("--names", nargs="+", choices=table.NAMES, default=table.NAMES)
    parser.add_argument("--solvers", nargs="+", choices=tuple(SOLVERS), default=tuple(SOLVERS))
    parser.add_argument("--evaluations", type=int, metavar="N", help="default: the script's")
    parser.add_argument("--baseline-evaluations", type=int, metavar="N", help="of Newton's only")
    parser.add_argument("--out", type=Path, help="default: runs/table44[_quick]")
    args = parser.parse_args()
    torch.set_num_threads(1)
    out = args.out or Path("runs/table44_quick" if args.quick else "runs/table44")
    write_json_atomic(out / "machine.json", machine())
    rows = table.make(
        out,
        names=args.names,
        solvers=args.solvers,
        quick=args.quick,
        evaluations=args.evaluations,
        baseline_evaluations=args.baseline_evaluations,
    )
    print(table.markdown(rows))


if __name__ == "__main__":
    with interruptible():
        main()
