"""Krylov solvers in a program of their own: Python reaches them through bodies alone."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GXX = shutil.which("g++")

pytestmark = pytest.mark.skipif(GXX is None or sys.platform == "win32", reason="needs g++")


def said(place: Path, *flags: str) -> tuple[int, str]:
    """What the program prints, compiled with assertions of the standard library."""
    program = place / "krylov"
    command = [
        *(str(GXX), "-std=c++17", "-O1", "-D_GLIBCXX_ASSERTIONS", *flags, f"-I{ROOT / 'csrc'}"),
        *(str(Path(__file__).with_name("krylov.cpp")), "-o", str(program), "-pthread"),
    ]
    subprocess.run(command, check=True)
    done = subprocess.run([program], capture_output=True, text=True)
    return done.returncode, done.stdout


def test_krylov_solvers(tmp_path):
    assert said(tmp_path) == (0, "right\n")


def test_a_wrong_product_is_seen(tmp_path):
    code, text = said(tmp_path, "-DMISTAKE=0.01")
    assert code == 1 and text.startswith("wrong: ")
