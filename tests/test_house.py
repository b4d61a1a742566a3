"""The house is as its map draws it: the tree, the paths that it names, no circle among files."""

import ast
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "diffsim"
MAP = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def drawn_folders() -> dict[str, str]:
    """Path of each folder in the tree of the map, and what is said of it."""
    tree = MAP.split("```\n")[1]
    found, above = {}, []
    for line in tree.splitlines():
        match = re.fullmatch(r"( *)(\w+)/ *(.*)", line)
        assert match is not None, f"not a line of the tree: {line!r}"
        above = [*above[: len(match[1]) // 2], match[2]]
        found["/".join(above)] = match[3]
    return found


def folders() -> set[str]:
    return {
        str(path.relative_to(ROOT))
        for path in (PACKAGE, *PACKAGE.rglob("*"))
        if path.is_dir() and path.name != "__pycache__" and any(path.glob("*.*"))
    }


def test_the_map_shows_the_folders_that_there_are():
    drawn = drawn_folders()
    assert set(drawn) == folders()
    assert all(what for path, what in drawn.items() if path != "diffsim")


TOP = "diffsim|csrc|examples|benchmarks|labs|tests"


@pytest.mark.parametrize("path", sorted(set(re.findall(rf"`((?:{TOP})/[^`* ]*)`", MAP))))
def test_paths_on_the_map_exist(path):
    assert (ROOT / path).exists()


def imports() -> dict[str, set[str]]:
    """Module to the modules of the package that it imports, wherever in its text."""
    files = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in PACKAGE.rglob("*.py")
    }
    found: dict[str, set[str]] = {}
    for name, path in files.items():
        asked: list[str] = []
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                asked += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: relative imports hide where things come from"
                # a name is the module of that name where there is one
                full = [f"{node.module}.{alias.name}" for alias in node.names]
                asked += [f if f in files else str(node.module) for f in full]
        found[name] = {a for a in asked if a in files and a != name}
    return found


def test_no_file_takes_part_in_a_circle_of_imports():
    graph = imports()
    place = {name: i for i, name in enumerate(graph)}
    edges = np.array([(place[a], place[b]) for a, of in graph.items() for b in of]).T
    matrix = csr_array((np.ones(edges.shape[1]), (edges[0], edges[1])), shape=(len(place),) * 2)
    count, label = connected_components(matrix, directed=True, connection="strong")
    names = np.array(list(graph))
    circles = [names[label == k].tolist() for k in range(count) if (label == k).sum() > 1]
    assert circles == []
