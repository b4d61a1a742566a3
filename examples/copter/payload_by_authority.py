"""What does authority cost? A sweep, one co-design per torque that must be left, side by side.

Each run is a co-design of the flat pentacopter for payload, with a torque about roll and pitch that
must be left at full load (and a tenth of it about yaw). Finished runs are kept in files of their
own, so that the same command goes on after an interruption, whoever computed them: this process,
workers here, or a cluster's.

Expected: 58.4 N without, 57.5, 56.7, 55.3 and 52.7 N with 0.25, 0.5, 1 and 2 N m; the same from
every executor. Running time: 10 CPU seconds.

    python examples/copter/payload_by_authority.py --out runs/authority --executor processes:2
"""

from __future__ import annotations

from diffsim.core.script import interruptible

import argparse
from collections.abc import Sequence
from pathlib import Path

from diffsim.cli.arguments import add_executor
from diffsim.copter import load_design
from diffsim.copter.codesign import Demands, SearchOptions, codesign
from diffsim.core import open_executor, run_kept

TORQUES = (0.0, 0.25, 0.5, 1.0, 2.0)  # about roll and pitch [N m]


def largest_weight(torque: float) -> dict[str, float]:
    """The most that a pentacopter lifts which keeps a torque [N m]; one run."""
    best = codesign(
        load_design("pentacopter"),
        "payload",
        demands=Demands(authority=(torque, torque, 0.1 * torque)),
        search=SearchOptions(num_starts=4),
    )
    return {"torque_Nm": torque, "weight_N": best.max_weight}


def main(argv: Sequence[str] | None = None) -> list[dict[str, float]]:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/authority"), help="of the runs")
    parser.add_argument("--torques", type=float, nargs="+", default=TORQUES, metavar="T")
    add_executor(parser, "co-designs")
    args = parser.parse_args(argv)
    runs = {f"torque_{t:g}": t for t in args.torques}
    with open_executor(args.executor) as executor:
        rows = run_kept(
            largest_weight, runs, args.out, executor, done=lambda name, _: print(f"done: {name}")
        )
    for row in rows.values():
        print(f"{row['torque_Nm']:5.2f} N m {row['weight_N']:7.2f} N")
    return list(rows.values())


if __name__ == "__main__":
    with interruptible("the same command goes on"):
        main()
