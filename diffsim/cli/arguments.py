"""Argument types and defaults that several files share."""

from __future__ import annotations

import argparse
from pathlib import Path

from diffsim.core.executors import executor_word

DIAGNOSES = "runs/diagnose"  # folder of the results, one folder per study
QUICK, FULL = "quick", "full"  # what a diagnosis may simulate
#: Folder of the published studies, by its place: its package would load PyTorch
PUBLISHED = Path(__file__).parents[1] / "systems" / "published"


def described() -> list[Path]:
    """Studies of published data sets that are described in a file."""
    return sorted(PUBLISHED.glob("*.yaml"))


def positive(text: str) -> int:
    """Parse a whole number from 1."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, got {value}")
    return value


def names(text: str) -> tuple[str, ...]:
    """Names parted by commas; blanks do not count."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def fact(text: str) -> tuple[str, str]:
    """Name and value of ``name=value``."""
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise argparse.ArgumentTypeError(f"must be name=value, got {text!r}")
    return name.strip(), value.strip()


def where(text: str) -> str:
    """A word of ``--executor``."""
    try:
        return executor_word(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def add_executor(parser: argparse.ArgumentParser, runs: str) -> None:
    """The option ``--executor``, the same for all commands that consist of many runs.

    Args:
        parser: Parser of the command.
        runs: What is computed side by side, such as "random designs".
    """
    parser.add_argument(
        "--executor",
        type=where,
        default="here",
        metavar="WHERE",
        help=f"who computes {runs}: here, one after another (default); processes[:N] of this "
        "machine; dask:ADDRESS, a cluster; MODULE:FUNCTION, your own",
    )
