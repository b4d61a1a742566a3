"""The build: kernels are compiled alike under every Python, and wheels carry the scripts."""

import ast
import re
from pathlib import Path

import pytest

from diffsim.applications import catalog
from diffsim.core import paths

ROOT = Path(__file__).resolve().parents[1]
SETUP = ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))


def taken(*names: str) -> dict:
    """Functions and constants of setup.py, without running the rest of it."""
    kept = [
        node
        for node in SETUP.body
        if getattr(node, "name", None) in names
        or (isinstance(node, ast.Assign) and getattr(node.targets[0], "id", None) in names)
    ]
    space: dict = {}
    exec(compile(ast.Module(kept, []), "setup.py", "exec"), space)
    return space


@pytest.mark.parametrize(
    "command",  # of Python 3.10, 3.11, and of 3.12 and later
    [
        "g++ -Wno-unused-result -Wsign-compare -DNDEBUG -g -fwrapv -O3 -Wall -fPIC",
        "g++ -Wsign-compare -DNDEBUG -g -fwrapv -O3 -Wall -fPIC",
        "g++ -fno-strict-overflow -Wsign-compare -DNDEBUG -g -O3 -Wall -fPIC",
    ],
)
def test_kernels_are_compiled_alike_under_every_python(command):
    of_kernels = taken("of_kernels", "PYTHONS_OWN")["of_kernels"]
    expected = ["g++", "-Wsign-compare", "-DNDEBUG", "-g", "-fwrapv", "-O3", "-Wall", "-fPIC"]
    assert of_kernels(command.split()) == expected
    assert of_kernels([]) == [] and of_kernels(["ccache", "g++"]) == ["ccache", "g++", "-fwrapv"]


def test_scripts_of_the_checkout_are_found_and_shipped():
    assert paths.SCRIPTS == ROOT
    assert set(taken("SCRIPTS")["SCRIPTS"]) == {"examples", "rl"}
    found = catalog.examples()
    assert found["train_ppo"].group == "rl" and found["sliding_block"].group == "contact"


def test_all_pages_and_scripts_of_templates_are_packaged():
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    patterns = re.findall(r'"templates/\*\.(\w+)"', project)
    present = {p.suffix[1:] for p in (ROOT / "diffsim" / "viz" / "templates").iterdir()}
    assert present == set(patterns)
