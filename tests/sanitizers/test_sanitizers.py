"""Kernels under sanitizers: the core and its tests under ASan and UBSan, the pool under TSan.

Slow: the core is built again, into ``build/sanitized``; later runs compile what has changed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLACE = ROOT / "build" / "sanitized"
POOL = Path(__file__).with_name("pool.cpp")
KERNEL_TESTS = (
    "tests/linalg",
    "tests/ode",
    "tests/contact/test_detect.py",
    "tests/copter/test_ops.py",
    "tests/soft/test_input_checks.py",
    "tests/soft/test_step_order.py",
    "tests/stokes/test_cut_cells.py",
    "tests/test_fuzz.py",
)
BUILD_WALL_S, TEST_WALL_S = 3600.0, 3600.0
GXX = shutil.which("g++")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(GXX is None or sys.platform != "linux", reason="needs g++ on Linux"),
]


def compiled(sanitizer: str, place: Path, *more: str) -> Path:
    """The pool's program, built with a sanitizer."""
    program = place / "pool"
    flags = ["-std=c++17", "-O1", "-g", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all"]
    command = [GXX, *flags, *more, f"-I{ROOT / 'csrc'}", str(POOL), "-o", str(program), "-pthread"]
    subprocess.run([str(part) for part in command], check=True)
    return program


@pytest.mark.parametrize("sanitizer", ["thread", "address,undefined"])
def test_the_pool_is_clean(sanitizer, tmp_path):
    done = subprocess.run([compiled(sanitizer, tmp_path)], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "right\n"), done.stderr[-3000:]


@pytest.mark.parametrize(
    ("sanitizer", "mistake", "said"),
    [("thread", 0, "data race"), ("address,undefined", 1000, "heap-buffer-overflow")],
)
def test_mistakes_are_seen(sanitizer, mistake, said, tmp_path):
    program = compiled(sanitizer, tmp_path, f"-DMISTAKE={mistake}")
    done = subprocess.run([program], capture_output=True, text=True)
    assert done.returncode != 0 and said in done.stderr


def library(name: str) -> str:
    """Path of a library of the compiler."""
    said = subprocess.run([str(GXX), f"-print-file-name={name}"], capture_output=True, text=True)
    return str(Path(said.stdout.strip()).resolve())


@pytest.fixture(scope="module")
def sanitized() -> Path:
    """A copy of the package and its tests, with a core built with ASan and UBSan."""
    pytest.importorskip("nanobind", reason="pip install -c constraints.txt nanobind cmeel-eigen")
    place = PLACE / "address"
    for name in ("diffsim", "tests", "examples", "benchmarks"):
        shutil.rmtree(place / name, ignore_errors=True)
        shutil.copytree(
            ROOT / name, place / name, ignore=shutil.ignore_patterns("*.so", "__pycache__")
        )
    shutil.copy(ROOT / "pyproject.toml", place)
    flags = "-O1 -g1 -UNDEBUG -fsanitize=address,undefined -fno-sanitize-recover=undefined"
    env = {**os.environ, "DIFFSIM_BUILD_FLAGS": flags, "DIFFSIM_BUILD_ISA": "baseline"}
    command = [sys.executable, "setup.py", "build_ext", "--build-lib", str(place)]
    built = subprocess.run(
        command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=BUILD_WALL_S
    )
    assert built.returncode == 0, built.stderr[-3000:]
    return place


def test_kernels_are_clean_under_asan_and_ubsan(sanitized):
    env = {
        **os.environ,
        "DIFFSIM_ISA": "baseline",
        "LD_PRELOAD": f"{library('libasan.so')}:{library('libstdc++.so')}",
        "ASAN_OPTIONS": "detect_leaks=0",  # Python's own allocations live until the end
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "PYTHONPATH": str(sanitized),
    }
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *KERNEL_TESTS]
    done = subprocess.run(
        command, cwd=sanitized, env=env, capture_output=True, text=True, timeout=TEST_WALL_S
    )
    said = done.stdout[-3000:] + done.stderr[-6000:]
    assert done.returncode == 0 and "Sanitizer" not in said, said
