"""``python -m labs.unlisted``: hide laws that no library lists, diagnose, and count."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from diffsim.cli.arguments import add_executor, names, positive
from diffsim.core import interruptible, open_executor, run_kept
from diffsim.core.check import require_choice
from labs.command import ended, kept
from labs.rates.case import EFFORTS
from labs.rates.plan import planned
from labs.unlisted.case import in_order, items, solve
from labs.unlisted.catalog import KINDS
from labs.unlisted.page import write_page

RESULTS = "results"
WHOLE = "1.2e7"  # steps: those of a first answer, but with a budget of their own for laws


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m labs.unlisted",
        description="Hide laws that no library lists in recordings, diagnose them as a user "
        "would, and count what is found. The same command goes on with a run.",
    )
    parser.add_argument(
        "--cases", type=positive, metavar="N",
        help="cases; each kind comes once before any comes again (default: one of each)",
    )  # fmt: skip
    parser.add_argument(
        "--only", type=names, default=tuple(KINDS), metavar="KIND,...",
        help=f"of {', '.join(KINDS)} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--effort", choices=(*EFFORTS, WHOLE), default=WHOLE,
        help="default: %(default)s steps, and as many again for laws",
    )  # fmt: skip
    parser.add_argument(
        "--seed", type=int, help="master seed; drawn afresh if not given: only then it is sealed"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; resumes there")
    parser.add_argument("--page", type=Path, help="write the page there, too")
    add_executor(parser, "cases")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, record, diagnose and count.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, 2 after an error, 130 after Ctrl-C.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    args = arguments().parse_args(given)
    return ended(
        lambda: work(args), f"python -m labs.unlisted {shlex.join(given)}", debug=args.debug
    )


def work(args: argparse.Namespace) -> None:
    """Record and diagnose the cases that were asked for, and write the page of the run."""
    for kind in args.only:
        require_choice("--only", kind, KINDS)
    plan = planned(
        argparse.Namespace(out=args.out, effort=args.effort, master=args.seed, domain=())
    )
    print(f"master seed {plan['master']}, commit {plan['commit'][:10]}")
    wanted = items(args.only, args.cases or len(args.only), plan)
    with open_executor(args.executor) as executor:
        run_kept(
            partial(solve, out=args.out), wanted, args.out / RESULTS, executor,
            done=lambda _, row: say(row),
        )  # fmt: skip
    rows = finished(args.out, plan)
    for path in filter(None, (args.out / "unlisted.md", args.page)):
        print(f"wrote {write_page(rows, plan, path)}")


def finished(out: Path, plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All cases of the run that have ended, whichever call asked for them.

    Args:
        out: Folder of the run.
        plan: Of the run.
    """
    return sorted(kept(out / RESULTS, plan), key=in_order)


def say(row: Mapping[str, Any]) -> None:
    """One line for a finished case."""
    print(f"{row['case']}: {row['verdict']}, {row['said']}; {row['cpu_s']:.0f} CPU s", flush=True)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
