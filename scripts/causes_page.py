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
    """A section for each table."""
    from diffsim.causes import domains

    return "\n\n".join(section(domain) for domain in domains()) + "\n"


def section(domain: str) -> str:
    """Causes of a table: name, where they act, usual size, what they do, what looks alike."""
    from diffsim.causes import rows

    if not (own := rows(domain)):
        return f"## {title(domain)}\n\nIts own table has none; it takes {included(domain)}."
    columns = ("cause", "acts on", "usual size", "what it does", "when it is judged", "looks like")
    head = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    body = [" | ".join(cells(row)) for row in own.values()]
    lines = [*head, *(f"| {line} |" for line in body)]
    more = f"\n\nIt takes {included(domain)} besides." if included(domain) else ""
    return f"## {title(domain)}\n\n" + "\n".join(lines) + more


def title(domain: str) -> str:
    """Heading of a table."""
    return domain.replace("_", " ").capitalize()


def included(domain: str) -> str:
    """Rows that a table takes from others, table by table."""
    from diffsim.causes.catalogue import rows_in_order

    taken: dict[str, list[str]] = {}
    for of, row in rows_in_order(domain):
        if of != domain:
            taken.setdefault(of, []).append(f"`{row.name}`")
    return "; ".join(f"of *{title(of)}* {', '.join(names)}" for of, names in taken.items())


def judged(row: Row) -> str:
    """When a row is judged, in words: by its facts, its parts and what a study must have."""
    said = ["samples in time"] if row.over_time else []
    said += [f"{fact.replace('_', ' ')}" for fact in row.when]
    said += [f"not {fact.replace('_', ' ')}" for fact in row.unless]
    said += [f"not for {kind.replace('_', ' ')}" for kind in row.not_for]
    said += [f"for each {row.each}"] if row.each else []
    said += [f"per {row.per}"] if row.per else []
    needs = {k: v for k, v in (row.needs or {}).items() if v != "nothing"}
    said += [f"needs {v.replace('_', ' ')}" for v in dict.fromkeys(needs.values())]
    return ", ".join(said) or "always"


def cells(row: Row) -> tuple[str, ...]:
    """Cells of a row."""
    stated = row.typical["any"]
    unit = "" if row.unit == "-" else f" {row.unit}"
    size = f"`{stated}`{unit}" if isinstance(stated, str) else f"{stated:g}{unit}"
    bounds = ", never negative" if row.said("one_sided") else ""
    told = (f"`{row.name}`", row.at, size + bounds, row.form, judged(row), "; ".join(row.like))
    return tuple(cell.replace("|", r"\|") for cell in told)


def main() -> None:
    """Keep what stands above the mark, and write the tables below it."""
    sys.path.insert(0, str(ROOT))
    above = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    PAGE.write_text(f"{above}{MARK}\n{page()}", encoding="utf-8")
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
