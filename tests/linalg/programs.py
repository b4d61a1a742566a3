"""Kernels that Python cannot reach alone, in programs of their own."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CSRC = Path(__file__).parents[2] / "csrc"
GXX = shutil.which("g++")

needs_gxx = pytest.mark.skipif(GXX is None or sys.platform == "win32", reason="needs g++")


def compiled(name: str, folder: Path, *flags: str) -> Path:
    """The program of ``name``.cpp beside this file, with assertions of the standard library."""
    made = folder / name
    command = [
        *(str(GXX), "-std=c++17", "-O1", "-D_GLIBCXX_ASSERTIONS", f"-I{CSRC}", *flags),
        *(str(Path(__file__).with_name(f"{name}.cpp")), "-o", str(made), "-pthread"),
    ]
    subprocess.run(command, check=True)
    return made


def said(program: Path, *mistake: str) -> tuple[int, str]:
    """What it returns and prints."""
    done = subprocess.run([program, *mistake], capture_output=True, text=True)
    return done.returncode, done.stdout
