"""``python -m labs.blind``: seal cases of a virtual laboratory, diagnose them, and count."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from diffsim.cli.arguments import add_executor, names, positive
from diffsim.core import interruptible, open_executor
from diffsim.core.errors import DiffsimError
from labs.blind.sessions import kept_scores, planned
from labs.blind.table import markdown

SYSTEMS = ("beam", "copter", "network")  # virtual laboratories, as users call them


def arguments() -> argparse.ArgumentParser:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m labs.blind",
        description="Hide effects in virtual laboratories, diagnose them unseen, and count what "
        "is right.",
    )
    parser.add_argument("--n", type=positive, default=40, help="cases (default: 40)")
    parser.add_argument("--seed", type=int, help="of the cases; fresh and printed if not given")
    parser.add_argument("--system", choices=SYSTEMS, default="copter", help="default: %(default)s")
    parser.add_argument("--kinds", type=names, default=(), metavar="A,B", help="only such cases")
    parser.add_argument("--out", type=Path, help="default: runs/blind/SYSTEM_SEED; resumes there")
    parser.add_argument(
        "--vault", type=Path, help="folder of the labels, outside --out (default: OUT.vault)"
    )
    parser.add_argument("--quick", action="store_true", help="fewer refits")
    parser.add_argument(
        "--setup", type=Path, metavar="FILE.py", help="own model of the laboratory: setup(study)"
    )
    parser.add_argument(
        "--timeout", type=float, default=3600.0, metavar="S", help="per case (default: 3600)"
    )
    add_executor(parser, "cases")
    parser.add_argument(
        "--tables",
        type=Path,
        nargs="+",
        metavar="OUT",
        help="print the tables of finished cases of such folders together; nothing is diagnosed",
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Seal, diagnose and score.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, 2 after an error, 130 after Ctrl-C.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    args = arguments().parse_args(given)
    try:
        if args.tables:
            command = f"python -m labs.blind {shlex.join(given)}"
            print(markdown(kept_scores(args.tables), title="Sealed cases", command=command))
            return 0
        blind = planned(args)
        print(f"seed {blind.seed}; data and answers in {blind.out}, labels in {blind.vault}")
        with open_executor(args.executor) as executor:
            page = blind.write(blind.run(args.n, executor))
        print(page.read_text(encoding="utf-8"))
        print(f"wrote {page} and {page.with_suffix('.json')}")
        return 0
    except KeyboardInterrupt:
        print("\ninterrupted; finished cases are kept", file=sys.stderr)
        print(f"go on with: python -m labs.blind {shlex.join(given)}", file=sys.stderr)
        return 130
    except (DiffsimError, ValueError, OSError, ImportError) as error:
        if args.debug:
            raise
        print(f"{type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    with interruptible():
        sys.exit(main())
