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
from labs.calibration.answers import changed, followed
from labs.calibration.table import page
from labs.calibration.thresholds import FACTORS, listed, variant
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
    parser.add_argument(
        "--n",
        type=counts,
        default=(12,),
        metavar="N[,N]",
        help="cases per domain: one number for all, or one for each (default: 12)",
    )
    parser.add_argument(
        "--again", type=positive, default=6, metavar="N",
        help="cases that are answered again with a changed threshold, of those that it may change "
        "(default: 6)",
    )  # fmt: skip
    parser.add_argument("--master", type=int, default=1, help="of the cases (default: 1)")
    parser.add_argument("--effort", choices=EFFORTS, default=QUICK, help="default: %(default)s")
    parser.add_argument(
        "--only", type=names, default=(), metavar="A,B", help="thresholds with these names alone"
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


def counts(text: str) -> tuple[int, ...]:
    """Parse whole numbers from 1, parted by commas."""
    return tuple(map(positive, names(text)))


def work(args: argparse.Namespace) -> None:
    """Answer cases again, and write the page.

    Raises:
        ValueError: an unknown domain, or more or fewer numbers of cases than domains.
    """
    for domain in args.domain:
        require_choice("--domain", domain, DOMAINS)
    if len(args.n) not in (1, len(args.domain)):
        raise ValueError(f"--n has {len(args.n)} numbers for {len(args.domain)} domains: one each")
    first, again = answers(args)
    text = page(first, again, vars(args), head()[0])
    for path in filter(None, (args.out / "thresholds.md", args.page)):
        print(f"wrote {write_text_atomic(path, text)}")


def answers(args: argparse.Namespace) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """What was followed, by case; and answers with a changed threshold, by variant and case."""
    cases = drawn(args)
    with open_executor(args.executor) as executor:
        every = run_kept(followed, cases, args.out / "followed", executor, done=say)
        first = {name: result for name, result in every.items() if result}
        wanted = asked({name: cases[name] for name in first}, first, args)
        found = run_kept(changed, wanted, args.out / "changed", executor, done=say)
    again: dict[str, dict[str, Any]] = {}
    for name, answer in found.items():
        key, _, case = name.partition("__")
        again.setdefault(key, {})[case] = answer
    return first, again


def drawn(args: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Cases by name: those of domains with most of them first, domains in turn."""
    same = {"master": args.master, "effort": args.effort, "commit": head()[0]}
    same |= {"studies": str(args.out / "studies")}
    each = args.n if len(args.n) > 1 else args.n * len(args.domain)
    cases = [
        (-count, k, {**same, "domain": domain, "index": index})
        for domain, count in zip(args.domain, each, strict=True)
        for k, index in enumerate(recordable(args.master, domain, count))
    ]
    ordered = [item for *_, item in sorted(cases, key=lambda case: case[:2])]
    return {f"{item['domain']}_{item['index']:04d}": item for item in ordered}


def asked(
    cases: Mapping[str, Mapping[str, Any]], first: Mapping[str, Any], args: argparse.Namespace
) -> dict[str, dict[str, Any]]:
    """Answers with a changed threshold that are asked for: of each variant the first cases that it
    may change, as many as ``--again``."""
    return {
        f"{variant(threshold, factor)}__{name}": {
            **cases[name],
            "key": threshold.key,
            "factor": factor,
        }
        for threshold in listed()
        if not args.only or threshold.name in args.only
        for factor in FACTORS
        for name in [n for n in cases if variant(threshold, factor) in first[n]["asked"]][
            : args.again
        ]
    }


def say(name: str, _: Mapping[str, Any]) -> None:
    """One line for what has ended."""
    print(name, flush=True)


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
