"""``python -m labs.calibration``: each threshold halved and doubled, and what that changes."""

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
from diffsim.core.files import write_text_atomic
from labs.calibration.answers import judged, searched, variant
from labs.calibration.table import page
from labs.calibration.thresholds import FACTORS, SEARCH, listed
from labs.command import ended
from labs.rates.case import EFFORTS, QUICK
from labs.rates.domains import DOMAINS
from labs.rates.draw import recordable
from labs.rates.plan import head

CHEAP = ("toy", "ode", "bench")


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m labs.calibration",
        description="Halve and double each threshold that decides verdicts, answer cases again, "
        "and count what changes. The same command goes on.",
    )
    parser.add_argument(
        "--domain", type=names, default=CHEAP, metavar="A,B", help=f"default: {','.join(CHEAP)}"
    )
    parser.add_argument("--n", type=positive, default=12, help="cases per domain (default: 12)")
    parser.add_argument("--master", type=int, default=1, help="of the cases (default: 1)")
    parser.add_argument("--effort", choices=EFFORTS, default=QUICK, help="default: %(default)s")
    parser.add_argument(
        "--only", type=names, default=(), metavar="A,B", help="thresholds with these names alone"
    )
    parser.add_argument(
        "--most", type=positive, help="whole answers that this call makes; the rest next time"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the run; resumes there")
    parser.add_argument("--page", type=Path, help="write the page there, too")
    add_executor(parser, "answers")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Answer cases again and write the table.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, 2 after an error, 130 after Ctrl-C.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    args = arguments().parse_args(given)
    return ended(lambda: work(args), f"python -m labs.calibration {shlex.join(given)}")


def work(args: argparse.Namespace) -> None:
    """Answer cases again, and write the page."""
    for domain in args.domain:
        require_choice("--domain", domain, DOMAINS)
    found, cases = answers(args)
    text = page(found, cases, vars(args), head()[0])
    for path in filter(None, (args.out / "thresholds.md", args.page)):
        print(f"wrote {write_text_atomic(path, text)}")


def answers(args: argparse.Namespace) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
    """Answers by variant and case, "plain" among the variants; and the cases by name."""
    same = {"master": args.master, "effort": args.effort, "commit": head()[0]}
    cases = {
        f"{domain}_{index:04d}": {**same, "domain": domain, "index": index,
                                  "studies": str(args.out / "studies")}
        for domain in args.domain
        for index in recordable(args.master, domain, args.n)
    }  # fmt: skip
    with open_executor(args.executor) as executor:
        first = run_kept(judged, cases, args.out / "judged", executor, done=say)
        cases = {name: item for name, item in cases.items() if first[name]}
        whole = whole_items(cases, args)
        again = run_kept(searched, whole, args.out / "searched", executor, done=say)
    found: dict[str, dict[str, Any]] = {}
    for case, by_variant in first.items():
        for name, answer in by_variant.items():
            found.setdefault(name, {})[case] = answer
    for name, answer in again.items():
        key, _, case = name.partition("__")
        found.setdefault(key, {})[case] = answer
    return found, cases


def whole_items(
    cases: Mapping[str, Mapping[str, Any]], args: argparse.Namespace
) -> dict[str, dict[str, Any]]:
    """Whole answers that are asked for, as many new ones as this call may make."""
    items = {
        f"{variant(threshold, factor)}__{name}": {**item, "key": threshold.key, "factor": factor}
        for threshold in listed()
        if threshold.acts == SEARCH and (not args.only or threshold.name in args.only)
        for factor in FACTORS
        for name, item in cases.items()
    }
    made = [name for name in items if (args.out / "searched" / f"{name}.json").is_file()]
    new = [name for name in items if name not in set(made)][: args.most]
    kept = {*made, *new}
    return {name: item for name, item in items.items() if name in kept}


def say(name: str, _: Mapping[str, Any]) -> None:
    """One line for what has ended."""
    print(name, flush=True)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
