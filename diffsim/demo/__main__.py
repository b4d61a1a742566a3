"""``python -m diffsim.demo``: the same as ``diffsim demo``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from diffsim import demo


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The demo's flags."""
    parser.add_argument("--data", help="folder that holds silicone_beam/ (default: DIFFSIM_DATA)")
    parser.add_argument(
        "--out", default="runs/demo", help="folder to write to (default: runs/demo)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="coarse mesh, large steps: a first look"
    )
    parser.add_argument("--resume", action="store_true", help="reuse the finished stages in --out")
    parser.add_argument("--threads", type=int, help="simulations side by side (default: all cores)")


def run(args: argparse.Namespace) -> int:
    """Run the demo, print its verdict; 130 after Ctrl-C."""
    try:
        results = demo.main(
            data=args.data,
            out=args.out,
            quick=args.quick,
            resume=args.resume,
            threads=args.threads,
        )
    except KeyboardInterrupt:
        return 130
    if results["is_virtual"]:
        print(f"\n{demo.VIRTUAL_BANNER}")
    for sentence in results["verdict"]:
        print(f"\n{sentence}")
    print(f"\npage: {args.out}/report.html   numbers: {args.out}/results.json")
    if results["files"]["rerun"]:
        print(f"recording: {results['files']['rerun']}   (open with: rerun {args.out}/beam.rrd)")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Parse and run."""
    parser = argparse.ArgumentParser(prog="diffsim demo", description=demo.__doc__)
    add_arguments(parser)
    return run(parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
