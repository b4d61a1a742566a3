"""Write the tables of docs/api.md: what each room offers, from ``__all__``, docstrings, signatures.

python scripts/api_page.py
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "api.md"
MARK = "<!-- Below this line: written by scripts/api_page.py. -->\n"


def packages() -> list[str]:
    """The rooms and the folders in them that say what they offer, in alphabetical order."""
    import diffsim

    found = [p.name for p in pkgutil.walk_packages(diffsim.__path__, "diffsim.") if p.ispkg]
    return [name for name in sorted(found) if hasattr(importlib.import_module(name), "__all__")]


def first_line(thing: object) -> str:
    """What the docstring says first; of a constant, its type."""
    if not (inspect.isclass(thing) or inspect.isroutine(thing) or inspect.ismodule(thing)):
        return f"a constant ({type(thing).__name__})"
    lines = (inspect.getdoc(thing) or "").partition("\n\n")[0].split("\n")
    return " ".join(line.strip() for line in lines).replace("|", "\\|")


def defaults(thing: object) -> str:
    """Numbers, flags and words that a call takes where none are given; of methods too."""
    called = {"": thing}
    if inspect.isclass(thing):
        own = {n: getattr(f, "__func__", f) for n, f in vars(thing).items() if n[0] != "_"}
        made = thing.__new__ if issubclass(thing, tuple) else thing.__init__
        called = {"": made} | {f".{n}": f for n, f in own.items()}
    found = []
    for name, function in called.items():
        if inspect.isfunction(inspect.unwrap(function)):
            taken = inspect.signature(function).parameters.values()
            plain = [p for p in taken if isinstance(p.default, (bool, int, float, str))]
            said = ", ".join(f"{p.name}={p.default!r}" for p in plain)
            found += [f"{name}({said})" if name else said] if said else []
    return "; ".join(f"`{one}`" for one in found)


def table(name: str) -> str:
    """The section of one package."""
    package = importlib.import_module(name)
    things = {n: getattr(package, n) for n in sorted(package.__all__)}
    rows = [f"| `{n}` | {first_line(thing)} | {defaults(thing)} |" for n, thing in things.items()]
    head = [
        f"### {name}",
        "",
        first_line(package),
        "",
        "| name | what | defaults |",
        "|---|---|---|",
    ]
    return "\n".join([*head, *rows])


def main() -> None:
    """Keep what stands above the mark, and write the tables below it."""
    sys.path.insert(0, str(ROOT))
    above = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    tables = "\n\n".join(table(name) for name in packages())
    PAGE.write_text(f"{above}{MARK}\n{tables}\n", encoding="utf-8")
    print(f"wrote {PAGE}")


if __name__ == "__main__":
    main()
