"""Write docs/causes.md: every cause that the library knows, from the tables of the catalogue.

python scripts/causes_page.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from diffsim.causes import Row

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "causes.md"
MARK = "<!-- Below this line: written by scripts/causes_page.py. -->\n"


def page() -> str:
    """A section for each table that has rows of its own."""
    from diffsim.causes import domains, rows

    return "\n\n".join(section(domain) for domain in domains() if rows(domain)) + "\n"


def section(domain: str) -> str:
    """Causes of a table: name, where they act, usual size, what they do, what looks alike."""
    from diffsim.causes import rows

    head = ["| cause | acts on | usual size | what it does | looks like |", "|---|---|---|---|---|"]
    body = [" | ".join(cells(row)) for row in rows(domain).values()]
    lines = [*head, *(f"| {line} |" for line in body)]
    return f"## {domain.replace('_', ' ').capitalize()}\n\n" + "\n".join(lines)


def cells(row: Row) -> tuple[str, ...]:
    """Cells of a row."""
    stated = row.typical["any"]
    unit = "" if row.unit == "-" else f" {row.unit}"
    size = f"`{stated}`{unit}" if isinstance(stated, str) else f"{stated:g}{unit}"
    bounds = ", never negative" if row.said("one_sided") else ""
    told = (f"`{row.name}`", row.at, size + bounds, row.form, "; ".join(row.like))
    return tuple(cell.replace("|", r"\|") for cell in told)


def main() -> None:
    """Keep what stands above the mark, and write the tables below it."""
    sys.path.insert(0, str(ROOT))
    above = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    PAGE.write_text(f"{above}{MARK}\n{page()}", encoding="utf-8")
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
