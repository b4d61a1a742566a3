"""Write docs/study_keys.md: every key of ``study.yaml``, from the descriptions of the keys.

python scripts/study_keys_page.py
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffsim.core.schema import Part

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "study_keys.md"
MARK = "<!-- Below this line: written by scripts/study_keys_page.py. -->\n"


def page() -> str:
    """All sections: the study file, what all descriptions share, then one per kind of system."""
    from diffsim.core.schema_keys import blocks_of
    from diffsim.data.study_schema import Fact, StudyFile
    from diffsim.systems.description import EffectChoice, Effort, Quantity
    from diffsim.systems.registry import DESCRIPTIONS

    shared = [Quantity, EffectChoice, Effort]
    parts = ["## The study file", *sections([*blocks_of(StudyFile), Fact], "study.yaml")]
    parts += ["## What all descriptions share", *sections(shared, "")]
    for system, (module, name) in sorted(DESCRIPTIONS.items()):
        try:
            description = getattr(importlib.import_module(module), name)
        except ModuleNotFoundError as error:
            if error.name is None or not module.startswith(error.name):
                raise  # the module is there, and needs what is not
            continue
        own = [block for block in blocks_of(description) if block not in shared]
        parts += [f"## model: {{system: {system}}}", *sections(own, "model")]
    return "\n\n".join(parts) + "\n"


def sections(blocks: Sequence[type[Part]], outermost: str) -> Iterator[str]:
    """A table for each block; the first is called as the file has it."""
    for i, block in enumerate(blocks):
        title = f"`{outermost}`" if outermost and i == 0 else block.__name__
        base = next((b for b in block.__bases__ if b in blocks), None)
        more = "" if base is None else f" All keys of {base.__name__}, and:"
        yield f"### {title}\n\n{first_sentence(block)}{more}\n\n{table(block, base)}"


def table(block: type[Part], base: type[Part] | None) -> str:
    """Keys of a block that its base has not: what stands there, what holds without, its sense."""
    from diffsim.core.schema_keys import keys_of

    known = {key.name: key for key in keys_of(base)} if base is not None else {}
    rows = ["| key | value | default | meaning |", "|---|---|---|---|"]
    for key in keys_of(block):
        if known.get(key.name) == key:
            continue
        default = "**needed**" if key.default is None else key.default
        cells = (f"`{key.name}`", key.kind, default, key.meaning)
        rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(rows)


def first_sentence(block: type[Part]) -> str:
    """What the docstring says first."""
    text = " ".join((block.__doc__ or "").split())
    return re.split(r"(?<=\.)\s", text, maxsplit=1)[0]


def main() -> None:
    """Keep what stands above the mark, and write the tables below it."""
    sys.path.insert(0, str(ROOT))
    above = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    PAGE.write_text(f"{above}{MARK}\n{page()}", encoding="utf-8")
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
