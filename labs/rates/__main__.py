"""``python -m labs.rates``: draw sealed cases, diagnose them, and count what is right."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.cli.arguments import add_executor, names, positive
from diffsim.core import interruptible, open_executor, run_kept
from diffsim.core.check import require_choice
from labs.command import ended, kept
from labs.rates.case import EFFORTS, QUICK, solve
from labs.rates.domains import DOMAINS
from labs.rates.draw import recordable
from labs.rates.page import write_page
from labs.rates.plan import items, planned
from labs.rates.sentences import write_sentences


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m labs.rates",
        description="Draw sealed cases of many systems, diagnose them as a user would, and count "
        "how often answers are right, open and wrong. The same command goes on with a run.",
    )
    parser.add_argument(
        "--domain", type=names, default=tuple(DOMAINS), metavar="A,B",
        help=f"of {', '.join(DOMAINS)} (default: all)",
    )  # fmt: skip
    parser.add_argument("--n", type=positive, default=30, help="cases per domain (default: 30)")
    parser.add_argument(
        "--only", type=names, default=(), metavar="toy_0007,...", help="these cases alone"
    )
    parser.add_argument("--effort", choices=EFFORTS, default=QUICK, help="default: %(default)s")
    parser.add_argument(
        "--far", action="store_true", help="judge the fitted command that moved most, too"
    )
    parser.add_argument(
        "--master", type=int, help="master seed; drawn afresh if not given: only then it is sealed"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; resumes there")
    parser.add_argument(
        "--page", type=Path, help="write the page there, too (studies/records/rates.md)"
    )
    add_executor(parser, "cases")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Draw, diagnose and count.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, 2 after an error, 130 after Ctrl-C.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    args = arguments().parse_args(given)
    again = f"python -m labs.rates {shlex.join(given)}"
    return ended(lambda: work(args), again, debug=args.debug)


def work(args: argparse.Namespace) -> None:
    """Diagnose the cases that were asked for, and write the page of the run."""
    for domain in args.domain:
        require_choice("--domain", domain, DOMAINS)
    plan = planned(args)
    print(f"master seed {plan['master']}, commit {plan['commit'][:10]}, {_sealed(plan)}")
    with open_executor(args.executor) as executor:
        run_kept(solve, wanted(args, plan), args.out / "cases", executor, done=lambda _, r: say(r))
    print(f"wrote {write_pages(finished(args.out, plan), plan, args)}")


def _sealed(plan: Mapping[str, Any]) -> str:
    return "sealed" if plan["sealed"] else f"not sealed: {plan['why_not_sealed']}"


def wanted(args: argparse.Namespace, plan: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Cases by name.

    Raises:
        ValueError: ``--only`` names a case of no domain.
    """
    if not args.only:
        return items(plan, {d: recordable(plan["master"], d, args.n) for d in args.domain})
    numbers: dict[str, list[int]] = {}
    for name in args.only:
        domain, _, index = name.rpartition("_")
        numbers.setdefault(require_choice("--only", domain, DOMAINS), []).append(int(index))
    return items(plan, numbers)


def finished(out: Path, plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    """All cases of the run that have ended, whichever call asked for them.

    Args:
        out: Folder of the run.
        plan: Of the run.
    """
    of_run = kept(out / "cases", plan)
    return sorted(of_run, key=lambda r: (list(DOMAINS).index(r["domain"]), r["index"]))


def say(row: Mapping[str, Any]) -> None:
    """One line for a finished case."""
    print(
        f"{row['domain']}_{row['index']:04d} {row['rig']}: {row['outcome']} ({row['verdict']}), "
        f"{row['cpu_s']:.0f} CPU s",
        flush=True,
    )


def write_pages(
    rows: Sequence[Mapping[str, Any]], plan: Mapping[str, Any], args: argparse.Namespace
) -> Path:
    """First sentences, the page of the run, and the same where ``--page`` says."""
    print(f"wrote {write_sentences(rows, args.out / 'sentences.md')}")
    if args.page is not None:
        write_page(rows, plan, args.page)
    return write_page(rows, plan, args.out / "rates.md")


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
