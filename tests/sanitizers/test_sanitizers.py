"""Kernels under sanitizers: tests under ASan and UBSan, pool and threads of Python under TSan.

Slow: the core is built again, into ``build/sanitized``; later runs compile what has changed.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLACE = ROOT / "build" / "sanitized"
POOL = Path(__file__).with_name("pool.cpp")
KERNEL_TESTS = (
    "tests/linalg",
    "tests/ode",
    "tests/contact/test_contact_gradients.py::test_every_method",
    "tests/contact/test_contact_robustness.py::test_all_nodes_in_contact",
    "tests/contact/test_detect.py",
    "tests/soft/test_input_checks.py",
    "tests/soft/test_step_order.py",
    "tests/stokes/test_closest_surface.py",
    "tests/stokes/test_cut_cells.py",
    "tests/stokes/test_equations.py",
    "tests/stokes/test_flow_tangents.py",
    "tests/test_arguments.py",
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


def sanitized(sanitizer: str, place: Path) -> dict[str, str]:
    """The environment of a copy of the package and its tests, whose core has a sanitizer.

    Args:
        sanitizer: What -fsanitize takes; its first part names the library.
        place: Where to make the copy.
    """
    pytest.importorskip("nanobind", reason="pip install -c constraints.txt nanobind cmeel-eigen")
    for name in ("csrc", "diffsim", "tests", "examples", "benchmarks"):  # csrc: tests compile it
        shutil.rmtree(place / name, ignore_errors=True)
        shutil.copytree(
            ROOT / name, place / name, ignore=shutil.ignore_patterns("*.so", "__pycache__")
        )
    shutil.copy(ROOT / "pyproject.toml", place)
    flags = f"-O1 -g1 -UNDEBUG -fsanitize={sanitizer}"
    if "undefined" in sanitizer:
        flags += " -fno-sanitize-recover=undefined"
    env = {**os.environ, "DIFFSIM_BUILD_FLAGS": flags, "DIFFSIM_BUILD_ISA": "baseline"}
    command = [sys.executable, "setup.py", "build_ext", "--build-lib", str(place)]
    built = subprocess.run(
        command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=BUILD_WALL_S
    )
    assert built.returncode == 0, built.stderr[-3000:]
    runtime = {"address": "libasan.so", "thread": "libtsan.so"}[sanitizer.split(",")[0]]
    return {
        **os.environ,
        "DIFFSIM_ISA": "baseline",
        "LD_PRELOAD": f"{library(runtime)}:{library('libstdc++.so')}",
        "PYTHONPATH": str(place),
    }


def ran(command: list[str], place: Path, env: dict[str, str]) -> str:
    """What a command says, which must end well and without a sanitizer's report."""
    done = subprocess.run(
        command, cwd=place, env=env, capture_output=True, text=True, timeout=TEST_WALL_S
    )
    said = done.stdout[-3000:] + done.stderr[-6000:]
    assert done.returncode == 0 and "Sanitizer" not in said, said
    return done.stdout


def test_kernels_are_clean_under_asan_and_ubsan():
    place = PLACE / "address"
    env = sanitized("address,undefined", place)
    env["ASAN_OPTIONS"] = "detect_leaks=0"  # Python's own allocations live until the end
    env["UBSAN_OPTIONS"] = "print_stacktrace=1:halt_on_error=1"
    words = "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider"
    ran([sys.executable, *words, *KERNEL_TESTS], place, env)


@pytest.fixture(scope="module")
def under_tsan() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs a module of the tests on a core built with ThreadSanitizer."""
    place = PLACE / "thread"
    env = sanitized("thread", place)
    # Python and PyTorch are not instrumented: what the core does counts, and Python's own lock
    # orders nothing.
    env["TSAN_OPTIONS"] = "ignore_noninstrumented_modules=1:exitcode=66"
    env["OMP_NUM_THREADS"] = "1"
    # ThreadSanitizer's map of memory has no room for addresses as random as Linux makes them.
    fixed = [setarch, "-R"] if (setarch := shutil.which("setarch")) else []

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*fixed, sys.executable, "-m", *words],
            cwd=place,
            env=env,
            capture_output=True,
            text=True,
            timeout=TEST_WALL_S,
        )

    return run


def test_two_threads_of_python_do_not_race(under_tsan):
    """Soft steps, contact and Stokes flow on shared bodies, and their gradients."""
    done = under_tsan("tests.sanitizers.two_threads")
    assert (done.returncode, done.stdout) == (0, "same\n"), done.stderr[-6000:]


def test_a_race_of_two_threads_of_python_is_seen(under_tsan):
    done = under_tsan("tests.sanitizers.two_threads", "race")
    assert done.returncode == 66 and "data race" in done.stderr, done.stderr[-3000:]
    assert "cut_cells" in done.stderr
