"""Write the list of paths in docs/security.md: every key of users' files that names another file.

python scripts/security_page.py
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "security.md"
MARKS = ("<!-- paths: written by scripts/security_page.py -->\n", "<!-- end of paths -->\n")
_BLOCKS = re.compile(r"^class \w+\(.*(Part|Description|Keys|Source|Task)\)", re.MULTILINE)


@dataclass(frozen=True, order=True)
class StatedPath:
    """A key whose value is a path."""

    block: str  # class of its block, a kind of part, or a task
    key: str  # its name
    reach: str  # where the file may lie
    sense: str  # what the block is, in a sentence


def stated_paths() -> list[StatedPath]:
    """All of them: keys of blocks, options of tasks, options of parts of designs."""
    return sorted({*_of_blocks(), *_of_tasks(), *_of_parts()})


def _of_blocks() -> Iterator[StatedPath]:
    from diffsim.core.schema_keys import keys_of

    known = blocks()
    for block in known:
        inherited = {k.name for base in block.__bases__ if base in known for k in keys_of(base)}
        for key in keys_of(block):
            if key.reach is not None and key.name not in inherited:
                yield StatedPath(block.__name__, key.name, key.reach, _first_sentence(block))


def _of_tasks() -> Iterator[StatedPath]:
    from diffsim.core.schema_paths import INSIDE
    from diffsim.envs.task import Task

    blocks()
    for task in _below(Task):
        for option in task.__dict__.get("file_options", ()):
            yield StatedPath(f"task: {task.name}", option, INSIDE, _first_sentence(task))


def _of_parts() -> Iterator[StatedPath]:
    from diffsim.copter.vehicle.parts import PART_KINDS
    from diffsim.core.schema_paths import INSIDE

    for kind, maker in PART_KINDS.items():
        for name, argument in inspect.signature(maker).parameters.items():
            if "Path" in str(argument.annotation):
                yield StatedPath(f"kind: {kind}", name, INSIDE, _first_sentence(maker))


def blocks() -> list[type[Any]]:
    """All blocks of users' files."""
    from diffsim.core.schema import Part

    for path in sorted((ROOT / "diffsim").rglob("*.py")):
        if _BLOCKS.search(path.read_text(encoding="utf-8")):
            importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
    made = (block for block in _below(Part) if block.__module__.startswith("diffsim."))
    # keys of parts of designs are made of their makers' arguments, which _of_parts lists
    return [b for b in made if getattr(sys.modules[b.__module__], b.__name__, None) is b]


def _below(kind: type[Any]) -> list[type[Any]]:
    found: dict[type[Any], None] = {}
    one: type[Any]
    for one in kind.__subclasses__():
        found |= dict.fromkeys([one, *_below(one)])
    return list(found)


def _first_sentence(documented: object) -> str:
    text = " ".join((inspect.getdoc(documented) or "").split())
    return re.split(r"(?<=\.)\s", text, maxsplit=1)[0]


def table() -> str:
    """The table between the marks."""
    rows = ["| key | of | where the file may lie |", "|---|---|---|"]
    rows += [f"| `{p.key}` | `{p.block}`: {p.sense} | {p.reach} |" for p in stated_paths()]
    return "\n".join(rows) + "\n"


def main() -> None:
    """Put the table between the marks."""
    sys.path.insert(0, str(ROOT))
    above, _, rest = PAGE.read_text(encoding="utf-8").partition(MARKS[0])
    below = rest.partition(MARKS[1])[2]
    PAGE.write_text(f"{above}{MARKS[0]}{table()}{MARKS[1]}{below}", encoding="utf-8")
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
