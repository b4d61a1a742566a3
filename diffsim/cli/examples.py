"""``diffsim examples``: list them, run one, or make the gallery."""

from __future__ import annotations

import argparse
import ast
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from diffsim.core.paths import SCRIPTS, import_script

HELP = "list the examples, or run one by its name"
FOLDER = SCRIPTS / "examples"
_QUICK = {"--quick", "--small"}  # what scripts call their short version


@dataclass(frozen=True)
class Example:
    """A script: its name, file, and the question that its docstring opens with."""

    name: str
    path: Path
    question: str
    quick: str | None

    @property
    def group(self) -> str:
        """The folder that it lies in."""
        return self.path.parent.name


@cache  # the gallery asks for every result, and all scripts are read
def examples(folder: Path = FOLDER) -> dict[str, Example]:
    """All runnable examples by name, and the scripts of ``rl`` beside their folder.

    Raises:
        FileNotFoundError: there is no such folder.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"the examples are missing: {folder} does not exist; install the wheel anew, or clone "
            "the repository and install it with pip install -e ."
        )
    found = {}
    for path in [*sorted(folder.glob("*/*.py")), *sorted(folder.parent.glob("rl/*.py"))]:
        text = path.read_text(encoding="utf-8")
        if '__name__ == "__main__"' not in text:
            continue  # a helper module of its neighbors
        doc = ast.get_docstring(ast.parse(text)) or ""
        quick = next((flag for flag in sorted(_QUICK) if f'"{flag}"' in text), None)
        # options that several scripts share are not in their own text
        shared = "examples.applications.command" in text
        if quick is None and (shared or f"{path.name} --quick" in doc):
            quick = "--quick"
        found[path.stem] = Example(path.stem, path, doc.partition("\n")[0], quick)
    return found


def listing(found: dict[str, Example]) -> str:
    """A table for the terminal, by folder."""
    lines, group = [], ""
    for example in sorted(found.values(), key=lambda e: (e.group, e.name)):
        if example.group != group:
            group = example.group
            lines.append(f"{group}:")
        mark = "*" if example.quick else " "
        lines.append(f"  {example.name:24s}{mark} {example.question}")
    lines.append("* takes --quick.  diffsim examples run NAME [--quick] [-- options of the script]")
    return "\n".join(lines)


def run(name: str, *, quick: bool, options: Sequence[str]) -> int:
    """Run an example as its own process; returns its exit status.

    Raises:
        ValueError: unknown name, or ``quick`` where the script has no short version.
    """
    from diffsim.core.check import require_choice  # it loads PyTorch

    found = examples()
    example = found[require_choice("example", name, tuple(found))]
    arguments = list(options)
    if quick:
        if example.quick is None:
            raise ValueError(f"{name} has no short version; run it without --quick")
        arguments.insert(0, example.quick)
    return subprocess.run([sys.executable, str(example.path), *arguments], check=False).returncode


def add_arguments(parser: argparse.ArgumentParser, common: argparse.ArgumentParser) -> None:
    """A subcommand each for the list, one example and the gallery."""
    steps = parser.add_subparsers(dest="step", required=True, metavar="list|run|gallery")
    steps.add_parser("list", parents=[common], help="every example and its question")
    one = steps.add_parser("run", parents=[common], help="run one")
    one.add_argument("name", metavar="NAME", help="as diffsim examples list shows it")
    one.add_argument("--quick", action="store_true", help="its short version")
    one.epilog = "What follows -- goes to the script: diffsim examples run plant -- --help"
    gallery = steps.add_parser(
        "gallery", parents=[common], help="run what has a picture and a number, and make the page"
    )
    gallery.add_argument("names", nargs="*", metavar="NAME", help="only these (default: all)")
    gallery.add_argument(
        "--out", type=Path, default=Path("runs/gallery"), help="default: %(default)s"
    )
    gallery.add_argument("--docs", type=Path, help="put page and pictures into this docs folder")


def command(args: argparse.Namespace) -> int:
    """List, run, or make the gallery; returns the exit status."""
    if args.step == "list":
        print(listing(examples()))
        return 0
    if args.step == "gallery":
        gallery = import_script("examples.gallery")
        gallery.require_success(gallery.make(args.out, args.names, args.docs))
        print(f"page: {args.out / 'gallery.md'}")
        return 0
    return run(args.name, quick=args.quick, options=args.options)
