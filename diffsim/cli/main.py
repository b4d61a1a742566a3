"""The ``diffsim`` command: puts the subcommands together, and handles errors and Ctrl-C."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from diffsim.cli import (
    convert,
    data_sets,
    demo,
    devices,
    diagnose,
    examples,
    fabricate,
    fit_rotors,
    fly,
    info,
    play,
    serve,
    track,
)
from diffsim.core.errors import DiffsimError, Mistakes
from diffsim.core.inside import allow_links
from diffsim.core.interrupts import (
    EXIT_INTERRUPTED,
    ending_at_once,
    ending_in_one_line,
    terminate_as_interrupt,
)
from diffsim.core.progress import hide_progress
from diffsim.core.version import __version__

MOST_LETTERS = 2_000  # of a line of an error: one may quote what stands in a file
OF_ARRAYS = ".*(encountered in|empty slice|All-NaN|Degrees of freedom)"  # NumPy's: no user can act
EXIT_MISTAKE = 2  # what argparse uses too


def open_standard_streams() -> None:
    """Let the null device stand for standard streams that are closed.

    Else Python has None in their place, and the first file that is opened takes their number: what
    a library prints would go into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            mode = "w" if number else "r"
            # open as long as the process lasts
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


COMMANDS = {
    "demo": demo,
    "examples": examples,
    "diagnose": diagnose,
    "fly": fly,
    "play": play,
    "fabricate": fabricate,
    "track": track,
    "convert": convert,
    "data": data_sets,
    "devices": devices,
    "serve": serve,
    "fit-rotors": fit_rotors,
    "info": info,
}
"""By name, in the order of the help: each module has HELP, ``add_arguments`` and ``command``."""

WITH_STEPS = ("examples", "diagnose")  # their steps take the common arguments
RESUMED_BY_THE_SAME = ("demo", "devices", "diagnose")


def parser() -> argparse.ArgumentParser:
    """The command line, as ``diffsim --help`` shows it."""
    top = argparse.ArgumentParser(
        prog="diffsim", description="Design robots through differentiable simulation."
    )
    top.add_argument("--version", action="version", version=f"diffsim {__version__}")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show the traceback of an error")
    common.add_argument("--quiet", action="store_true", help="no progress, only results")
    common.add_argument(
        "--links",
        type=Path,
        action="append",
        default=[],
        metavar="FOLDER",
        help="links of yours beside a study may lead into FOLDER (repeat for several)",
    )
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, module in COMMANDS.items():
        if name in WITH_STEPS:
            made = commands.add_parser(name, help=module.HELP, description=module.HELP)
            module.add_arguments(made, common)
        else:
            made = commands.add_parser(
                name, parents=[common], help=module.HELP, description=module.HELP
            )
            module.add_arguments(made)
        made.set_defaults(run=module.command)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments without the program's name; None takes the process's own.

    Returns:
        Exit status: 0, 2 after a user's or a numerical error, 130 after Ctrl-C or SIGTERM.
    """
    if argv is None:  # of the process itself: a queue's or a service's stop is one, too
        open_standard_streams()
        terminate_as_interrupt()
    given = list(sys.argv[1:] if argv is None else argv)
    cut = given.index("--") if given[:2] == ["examples", "run"] and "--" in given else len(given)
    with ending_in_one_line() if argv is None else nullcontext():
        args = parser().parse_args(given[:cut])
    args.options = given[cut + 1 :]
    try:
        allow_links(args.links)
        hide_progress(args.quiet)
        with warnings.catch_warnings():
            if not args.debug:
                warnings.filterwarnings("ignore", OF_ARRAYS, RuntimeWarning)
            status = args.run(args) or 0
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        if argv is None:
            ending_at_once()
        print("\ninterrupted; finished work is kept", file=sys.stderr)
        again = given
        if args.command == "demo" and not args.resume:
            again.append("--resume")
        if args.command in RESUMED_BY_THE_SAME:
            print(f"go on with: diffsim {shlex.join(again)}", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:  # `diffsim info | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_MISTAKE
    except (DiffsimError, ValueError, ImportError, OSError, MemoryError) as err:
        if args.debug:
            raise
        print(f"diffsim: {_format_error(err)}", file=sys.stderr)
        print("(--debug shows where it came from)", file=sys.stderr)
        return EXIT_MISTAKE


def _format_error(error: Exception) -> str:
    """An error in one line, mistakes that were found together in a line each."""
    lines = str(error).splitlines() if isinstance(error, Mistakes) else [str(error)]
    lines = [_shorten(" ".join(line.split())) for line in lines]
    if len(lines) > 1:
        count = error.count if isinstance(error, Mistakes) else len(lines)
        return "\n    ".join([f"{count} mistakes:", *lines])
    if isinstance(error, MemoryError):
        lines = [f"more memory is needed than there is{': ' if lines[0] else ''}{lines[0]}"]
    kind = ValueError if isinstance(error, Mistakes) else type(error)
    return f"{kind.__name__}: {lines[0]}"


def _shorten(line: str) -> str:
    """A line that quotes a file, whose names may have any length."""
    more = len(line) - MOST_LETTERS
    if more <= 0:
        return line
    half = MOST_LETTERS // 2
    return f"{line[:half]} ... ({more} letters more) ... {line[-half:]}"


if __name__ == "__main__":
    raise SystemExit(main())
