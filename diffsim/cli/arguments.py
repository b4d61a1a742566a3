"""Argument types and defaults that several files share."""

from __future__ import annotations

import argparse
import os
from difflib import get_close_matches
from pathlib import Path

from diffsim.core.executors import executor_word

DIAGNOSES = "runs/diagnose"  # folder of the results, one folder per study
QUICK, FULL = "quick", "full"  # what a diagnosis may simulate
NO_STUDY = "no such study; give study.yaml or the folder that has it"
#: Folder of the published studies, by its place: its package would load PyTorch
PUBLISHED = Path(__file__).parents[1] / "systems" / "published"


def described() -> list[Path]:
    """Studies of published data sets that are described in a file."""
    return sorted(PUBLISHED.glob("*.yaml"))


def study_file(given: str) -> Path:
    """File or folder of a study, or the file of a published data set.

    Results may lie in a folder that is named like a published data set.

    Raises:
        FileNotFoundError: neither; the message offers the closest names.
    """
    path, known = Path(given), {path.stem: path for path in described()}
    is_results = path.is_dir() and given in known and not (path / "study.yaml").exists()
    if path.exists() and not is_results:
        return path
    if given in known:
        return known[given]
    if os.sep in given or given.endswith((".yaml", ".yml")):
        raise FileNotFoundError(f"{given}: {NO_STUDY}")
    close = get_close_matches(given, known, n=2)
    hint = f"; did you mean {' or '.join(map(repr, close))}?" if close else ""
    raise FileNotFoundError(
        f"{given} is no file or folder of a study, and STUDY must be one of {list(known)}, got "
        f"{given!r}{hint}"
    )


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
