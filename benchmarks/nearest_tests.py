"""Which tests come nearest to a line: steps over names, from what holds it to what a test says.

A test is near that says the name of the function or class that holds the line, or that of something
which uses it, and so on: every step counts a tenth, and a name the less, the more tests say it. A
test of the same folder counts more, and one that is called like the file. Names of Python are those
of definitions, of kernels those under which the bindings make them known. Only modules above the
file are walked, and only tests above it are found (``scripts/changed_tests.py``); those that no
name leads to come last.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
FOLDER = 0.05  # what a folder in a test's name counts; a name that one test says, a step away: 0.1
WORD = 20  # of what a folder counts: a word of a file's name that one test is called by
LOOK_AT_TEXT = (  # and see no answer: of every planted line, of what git knows
    "tests/benchmarks/test_planted_errors.py",
    "tests/test_changed.py",
)


def nearest_tests(file: str, line: int) -> list[str]:
    """Test files of all modules above a line, the nearest first, before all its own.

    Args:
        file: Path in the tree.
        line: Number of the line, from 1.
    """
    changed = _changed_tests()
    found = [t for t in changed.tests_of([file]) if t not in (*changed.ALWAYS, *LOOK_AT_TEXT)]
    steps = _steps_over_names(file, line)
    parts = Path(file).with_suffix("").parts
    room, stem = (parts[2] if parts[0] == "csrc" else parts[1]), parts[-1].strip("_")

    folders = set(parts[parts.index(room) + 1 : -1])
    words = {word for word in stem.split("_") if len(word) > 2} - {room}
    if parts[0] == "csrc":  # its tests have no folder of theirs
        folders.add(room)
    called = {t: {*Path(t).parts[1:-1], *Path(t).stem.split("_")} for t in found}
    if room == "cli":  # a command is said by its name
        called = {test: own | _words_of_file(test) for test, own in called.items()}
    of_word = Counter(word for own in called.values() for word in own & words)
    said = {test: _words_of_file(test) & steps.keys() for test in found}
    sayers = Counter(word for words in said.values() for word in words)

    def far(test: str) -> tuple[bool, float, str]:
        own = Path(test).stem in (f"test_{stem}", f"test_{room}_{stem}")
        shared = len(set(Path(test).parts) & set(parts)) + (f"tests/{room}/" in test)
        near = sum(0.1 ** steps[word] / sayers[word] for word in said[test])
        beside = Path(test).with_suffix("").parts
        alike = any(f in beside or beside[-1].startswith(f"test_{f}") for f in folders)
        alike += sum(WORD / of_word[word] for word in called[test] & words)
        return not own, -near * (1 + shared) - FOLDER * alike, test

    return sorted(found, key=far)


def _steps_over_names(file: str, line: int) -> dict[str, int]:
    """Names by the number of definitions between them and the line."""
    changed = _changed_tests()
    files = changed.tracked_files()
    above = changed.reach(changed.starts_of(file, files), changed.above())
    users: dict[str, set[str]] = defaultdict(set)
    for path in files:
        if path.startswith("diffsim/") and changed.node_of(path) in above:
            for name, words in _definitions(path):
                for word in words:
                    users[word].add(name)
    steps = dict.fromkeys(_holders(file, line), 0)
    waiting = list(steps)
    for word in waiting:  # grows as it is walked: breadth first
        for name in users.get(word, set()) - steps.keys():
            steps[name] = steps[word] + 1
            waiting.append(name)
    return steps


def _holders(file: str, line: int) -> list[str]:
    """Names of what holds a line."""
    text = (ROOT / file).read_text(encoding="utf-8")
    if file.endswith(".py"):
        around = _holders_in(ast.parse(text).body, line)
        return [name for name in around if not _is_called_unsaid(name)]
    changed = _changed_tests()
    stems = [Path(file).stem, *re.findall(r'^#include "(?:\S*/)?(\w+)\.h"', text, re.M)[:1]]
    including = changed.reach(stems, _includers())
    bindings = [p for p in (ROOT / "csrc/bindings").glob("*.cpp") if p.stem in including]
    known = r'(?:m\.def\(|class_<[^"]*\(m,)\s*"(\w+)"'
    return [name for path in bindings for name in re.findall(known, path.read_text())]


def _holders_in(body: list[ast.stmt], line: int) -> Iterator[str]:
    """Functions and classes around a line; nobody else can say what is within a function."""
    for node in body:
        if node.lineno <= line <= (node.end_lineno or line):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                yield node.name
            if isinstance(node, (ast.ClassDef, ast.If)):
                yield from _holders_in(node.body, line)


def sources_above(stem: str) -> list[str]:
    """Sources of C++ that an error in a file compiles: those that include it, and itself.

    Args:
        stem: Name of the file without its ending.
    """
    changed = _changed_tests()
    including = changed.reach([stem], _includers())
    sources = (path for path in changed.tracked_files() if path.endswith(".cpp"))
    return [path for path in sources if Path(path).stem in including]


@cache
def _includers() -> dict[str, set[str]]:
    changed = _changed_tests()
    return dict(changed.include_edges(changed.tracked_files()))


def _is_called_unsaid(name: str) -> bool:
    """Whether a method is called without its name: by an operator, by torch."""
    return name == "forward" or (name.startswith("__") and name.endswith("__"))


@cache
def _definitions(path: str) -> list[tuple[str, set[str]]]:
    """Names that a file defines, with the words that their definitions say."""
    if not path.endswith(".py"):
        return []
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return [*_definitions_in(tree.body), *_entries_of(tree)]


def _entries_of(tree: ast.AST) -> Iterator[tuple[str, set[str]]]:
    """Keys of tables, by which tests ask for what stands there."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            for key, value in zip(node.keys, node.values, strict=True):
                if isinstance(key, ast.Constant) and isinstance(key.value, str):
                    yield key.value, _words(value)


def _definitions_in(body: list[ast.stmt]) -> Iterator[tuple[str, set[str]]]:
    for node in body:
        if isinstance(node, ast.ClassDef):
            methods = list(_definitions_in(node.body))
            yield from ((n, words) for n, words in methods if not _is_called_unsaid(n))
            # whoever makes an object can call what it has
            unsaid = [words for name, words in methods if _is_called_unsaid(name)]
            bases = set().union(*map(_words, node.bases)) if node.bases else set()
            yield node.name, {name for name, _ in methods}.union(bases, *unsaid)
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            yield node.name, _words(node)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from ((t.id, _words(node)) for t in targets if isinstance(t, ast.Name))
        elif isinstance(node, ast.If):
            yield from _definitions_in([*node.body, *node.orelse])


@cache
def _words_of_file(path: str) -> set[str]:
    return _words(ast.parse((ROOT / path).read_text(encoding="utf-8")))


def _words(tree: ast.AST) -> set[str]:
    """Names that code says, with short texts, which registries take."""
    words = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            words.add(node.id)
        elif isinstance(node, ast.Attribute):
            words.add(node.attr)
        elif isinstance(node, ast.alias):
            words.add(node.name.rpartition(".")[2])
        elif isinstance(node, ast.Constant) and str(node.value).isidentifier():
            words.add(str(node.value))
    return words


@cache
def _changed_tests() -> ModuleType:
    path = ROOT / "scripts" / "changed_tests.py"
    spec = importlib.util.spec_from_file_location("changed_tests", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
