"""The examples and the scripts of training: what there is, and running one by its name."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from diffsim.core.check import require_choice
from diffsim.core.paths import SCRIPTS

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
    found = examples()
    example = found[require_choice("example", name, tuple(found))]
    arguments = list(options)
    if quick:
        if example.quick is None:
            raise ValueError(f"{name} has no short version; run it without --quick")
        arguments.insert(0, example.quick)
    return subprocess.run([sys.executable, str(example.path), *arguments], check=False).returncode
