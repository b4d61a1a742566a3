"""Krylov solvers in a program of their own: Python reaches them through bodies alone."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GXX = shutil.which("g++")

pytestmark = pytest.mark.skipif(GXX is None or sys.platform == "win32", reason="needs g++")


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """Compiled with assertions of the standard library."""
    made = tmp_path_factory.mktemp("krylov") / "krylov"
    command = [
        *(str(GXX), "-std=c++17", "-O1", "-D_GLIBCXX_ASSERTIONS", f"-I{ROOT / 'csrc'}"),
        *(str(Path(__file__).with_name("krylov.cpp")), "-o", str(made), "-pthread"),
    ]
    subprocess.run(command, check=True)
    return made


def said(program: Path, *mistake: str) -> tuple[int, str]:
    done = subprocess.run([program, *mistake], capture_output=True, text=True)
    return done.returncode, done.stdout


def test_krylov_solvers(program):
    assert said(program) == (0, "right\n")


def test_a_wrong_product_is_seen(program):
    code, text = said(program, "0.01")
    assert code == 1 and text.startswith("wrong: ")
