"""Rows of 3x3 blocks in a program of their own, for each instruction set that the processor has."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GXX = shutil.which("g++")
CPU = Path("/proc/cpuinfo")

pytestmark = pytest.mark.skipif(GXX is None or sys.platform == "win32", reason="needs g++")


@pytest.fixture(scope="module", params=["x86-64", "x86-64-v3", "x86-64-v4"])
def program(request, tmp_path_factory) -> Path:
    """Compiled with assertions of the standard library."""
    needs = {"x86-64-v3": "avx2", "x86-64-v4": "avx512dq"}.get(request.param)
    flags = CPU.read_text().split() if CPU.exists() else []
    if needs and needs not in flags:
        pytest.skip(f"the processor has no {needs}")
    if needs is None and "sse2" not in flags:
        pytest.skip("not an x86-64 processor")
    made = tmp_path_factory.mktemp("blocks") / "blocks"
    command = [
        *(str(GXX), "-std=c++17", "-O1", f"-march={request.param}", "-D_GLIBCXX_ASSERTIONS"),
        *(f"-I{ROOT / 'csrc'}", str(Path(__file__).with_name("blocks.cpp")), "-o", str(made)),
    ]
    subprocess.run(command, check=True)
    return made


def said(program: Path, *mistake: str) -> tuple[int, str]:
    done = subprocess.run([program, *mistake], capture_output=True, text=True)
    return done.returncode, done.stdout


def test_rows_of_blocks(program):
    assert said(program) == (0, "right\n")


def test_scales_that_16_bits_do_not_hold_are_seen(program):
    assert said(program, "-0.01") == (1, "wrong: a rounded number\n")
