"""The tests that a change can touch are found from the imports, and no others."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


CASES = [
    ("diffsim/stokes/flow.py", "stokes/test_flow", "copter/dynamics/test_hover"),
    ("diffsim/cli/info.py", "cli/test_main", "stokes/test_flow"),
    ("diffsim/viz/frames.py", "viz/test_frames", "soft/test_solvers"),
    # by a story's path, by the folder of the docs, by the package that reads its own files
    ("examples/stokes/amplifier.py", "examples/test_stokes", "examples/test_copter"),
    ("docs/soft.md", "docs/test_site", "soft/test_solvers"),
    (
        "diffsim/copter/design/designs/pentacopter.yaml",
        "copter/design/test_spec_file",
        "soft/test_solvers",
    ),
    # by inclusion: the room of the kernel and what stands above it
    ("csrc/kernels/stokes/flow_schur.cpp", "stokes/test_flow", "soft/test_solvers"),
    ("csrc/kernels/linalg/lanes.h", "soft/test_solvers", "data/test_refresh"),
    ("tests/helpers.py", "copter/dynamics/test_hover", "cli/test_main"),
]
ASK = (
    "import json, runpy, sys; tests_of = runpy.run_path(sys.argv[1])['tests_of']; "
    "print(json.dumps({path: tests_of([path] if path else []) for path in sys.argv[2:]}))"
)


@pytest.fixture(scope="module")
def tests_of(tmp_path_factory):
    """Tests of each changed file, asked for in another folder: the script needs no path there."""
    pytest.importorskip("grimp")
    changed = [case[0] for case in CASES]
    script = str(ROOT / "scripts" / "changed_tests.py")
    command = [sys.executable, "-c", ASK, script, *changed, "pyproject.toml", ""]
    folder = tmp_path_factory.mktemp("elsewhere")
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


@pytest.mark.cpu(12)  # the graph of all imports
@pytest.mark.parametrize(("changed", "meant", "not_meant"), CASES)
def test_tests_of_a_change(tests_of, changed, meant, not_meant):
    found = tests_of[changed]
    assert (ROOT / changed).exists()
    assert f"tests/{meant}.py" in found
    assert (ROOT / f"tests/{not_meant}.py").exists() and f"tests/{not_meant}.py" not in found
    assert "tests/test_house.py" in found


def test_what_lies_below_everything_asks_for_all(tests_of):
    assert tests_of["pyproject.toml"] == ["tests"]
    assert tests_of[""] == []


def test_the_command_finds_what_differs_from_the_first_commit(tmp_path):
    words = ["git", "rev-list", "HEAD"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    commits = done.stdout.split()
    if len(commits) < 2:
        pytest.skip("not a git checkout with a history")
    command = [sys.executable, str(ROOT / "scripts" / "changed_tests.py"), commits[-1]]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["tests"]  # pyproject.toml is among it
