"""Test files that a change can touch: those of the changed files and of all modules above them.

    python scripts/changed_tests.py               what differs from the last commit
    python scripts/changed_tests.py origin/main   what differs from where that branch was left

Prints one path a line; `./scripts/test --changed` runs them. Above a file stands

- what imports it, anywhere in its text (grimp's graph), and what imports that;
- what names it in a string: a module (lazy packages, registries), a file or its folder
  (stories, pages, tables that are read);
- for a C++ file the rooms of all sources that include it, directly or not;
- for a file that is no Python the package in whose folder it lies, which may read it.

The house's own rules are checked after each change. Where a changed file stands below everything
(pyproject.toml, what all tests share), all tests are meant, and ``tests`` is printed.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("diffsim", "benchmarks", "examples", "labs", "rl", "tests")
EVERYTHING = ("pyproject.toml", "constraints.txt", "setup.py", "tests/conftest.py")
ALWAYS = ("tests/test_api.py", "tests/test_house.py")
Edges = dict[str, set[str]]


def changed_files(since: str | None) -> list[str]:
    """Paths that differ from the last commit, or from where ``since`` was left; new ones, too."""

    def git(*words: str) -> list[str]:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"git {' '.join(words)}: {done.stderr.strip()}")
        return done.stdout.splitlines()

    start = "HEAD" if since is None else git("merge-base", since, "HEAD")[0]
    new = git("ls-files", "--others", "--exclude-standard")
    return sorted({*git("diff", "--name-only", start), *new})


def module_of(path: str) -> str:
    """Dotted name of a Python file, such as diffsim.soft for diffsim/soft/__init__.py."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def tracked_files() -> list[str]:
    """Files that git knows or would take, and that are there."""
    words = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    return [path for path in sorted(set(listed.stdout.splitlines())) if (ROOT / path).is_file()]


def texts_of(path: Path) -> Iterator[str]:
    """Strings in a Python file, and what it takes from ``diffsim`` by attribute."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", None) == "diffsim":
            yield f"diffsim.{node.attr}"


def node_of(path: str) -> str:
    """Name of a file in the graph: a module's, or its path."""
    return module_of(path) if path.endswith(".py") else path


def nodes_by_text(files: Iterable[str]) -> Edges:
    """What a string can mean: a path, its last two parts or more, or a folder with all it holds."""
    found: Edges = defaultdict(set)
    for path in files:
        parts = path.split("/")
        for i in range(max(1, len(parts) - 1)):
            found["/".join(parts[i:])].add(node_of(path))
        if not path.startswith("diffsim/"):
            found["/".join(parts[:-1]) or path].add(node_of(path))
    return found


def include_edges(files: Iterable[str]) -> Edges:
    """Stem of each C++ file to the stems of those that include it."""
    found: Edges = defaultdict(set)
    for path in files:
        if path.startswith("csrc/"):
            for name in re.findall(r'^#include "([^"]+)"', (ROOT / path).read_text(), re.M):
                found[Path(name).stem].add(Path(path).stem)
    return found


def reach(starts: Iterable[str], edges: Edges) -> set[str]:
    """All nodes that can be reached, the starts with them."""
    found, waiting = set(starts), list(starts)
    while waiting:
        for node in edges.get(waiting.pop(), set()) - found:
            found.add(node)
            waiting.append(node)
    return found


def rooms_of_kernel(path: str, files: list[str]) -> set[str]:
    """Modules of the rooms whose kernels or bindings include a C++ file."""
    touched = reach([Path(path).stem], include_edges(files))
    parts = [
        set(Path(p).with_suffix("").parts[2:])
        for p in files
        if p.startswith("csrc/") and Path(p).stem in touched
    ]
    words = {word for names in parts for name in names for word in (name, *name.split("_"))}
    rooms = {p.split("/")[1] for p in files if p.startswith("diffsim/") and p.count("/") > 1}
    meant = words & rooms or rooms
    return {
        module_of(p)
        for p in files
        if p.endswith(".py") and p.startswith("diffsim/") and p.split("/")[1] in meant
    }


@cache
def above() -> Edges:
    """Each module and file to those that import or name it."""
    files = tracked_files()
    if str(ROOT) not in sys.path:  # where grimp looks for packages
        sys.path.insert(0, str(ROOT))
    graph = grimp.build_graph(*PACKAGES, cache_dir=None, exclude_type_checking_imports=True)
    edges: Edges = defaultdict(set)
    for module in graph.modules - {"diffsim"}:
        edges[module] |= graph.find_modules_that_directly_import(module)
    by_text = nodes_by_text(files)
    for path in files:
        if not path.endswith(".py") or path == "diffsim/__init__.py":
            continue
        for text in texts_of(ROOT / path):
            if text in graph.modules and text != "diffsim":
                edges[text].add(module_of(path))
            elif not path.startswith("diffsim/"):  # the package reads only what lies in it
                for node in by_text.get(text.strip("/"), set()):
                    edges[node].add(module_of(path))
    return edges


def starts_of(path: str, files: list[str]) -> set[str]:
    """Nodes of the graph that a changed file is, or that may read it."""
    if path.endswith(".py"):
        return {module_of(path)}
    if path.startswith("csrc/"):
        return rooms_of_kernel(path, files)
    folder, beside = path, list[str]()
    while not beside and (folder := folder.rpartition("/")[0]):
        beside = [p for p in files if p.endswith(".py") and p.rpartition("/")[0] == folder]
    return {path, *map(module_of, beside)}


def tests_of(changed: Iterable[str]) -> list[str]:
    """Test files to run after a change, or ``["tests"]`` where all are meant."""
    changed = list(changed)
    if not changed:
        return []
    if any(path in EVERYTHING for path in changed):
        return ["tests"]
    files = tracked_files()
    starts = {node for path in changed for node in starts_of(path, files)}
    touched = reach(starts, above())
    tests = [p for p in files if re.fullmatch(r"tests/(.*/)?test_[^/]*\.py", p)]
    return sorted({p for p in tests if module_of(p) in touched} | set(ALWAYS))


if __name__ == "__main__":
    print("\n".join(tests_of(changed_files(sys.argv[1] if len(sys.argv) > 1 else None))))
