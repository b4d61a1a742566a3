"""The compiled core: what was built can be loaded, and DIFFSIM_ISA chooses among it."""

import os
import subprocess
import sys

import pytest

from diffsim.core import compiled, processor


def _load(isa):
    code = "from diffsim.core.compiled import core; print(core.instruction_set)"
    env = {**os.environ, "DIFFSIM_ISA": isa}
    return subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True)


@pytest.mark.parametrize("isa", compiled.available())
def test_every_available_core_loads(isa):
    done = _load(isa)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == isa  # it was compiled for what its name says


def test_unknown_instruction_set_lists_the_choices():
    done = _load("sse9")
    assert done.returncode != 0
    assert f"DIFFSIM_ISA='sse9' is not available here; choose from {compiled.available()}" in (
        done.stderr
    )


def test_an_old_processor_gets_the_baseline(monkeypatch):
    monkeypatch.setattr(compiled, "supported", lambda: ["baseline"])
    assert compiled.available() == [name for name in compiled.built() if name == "baseline"]


def test_each_level_contains_the_one_below():
    needs = processor.NEEDS
    assert needs["baseline"] < needs["avx2"] < needs["avx512"]


def test_a_processor_gets_the_best_level_it_has_in_full(monkeypatch):
    flags = processor.NEEDS["avx2"] | {"avx512f"}  # the first AVX-512 processors lack the rest
    monkeypatch.setattr(processor, "cpu_flags", lambda: flags)
    assert processor.supported() == ["avx2", "baseline"]


def test_the_build_reads_the_same_levels_as_the_import():
    """setup.py runs this file alone, before anything is installed."""
    import runpy

    assert runpy.run_path(processor.__file__)["supported"]() == processor.supported()


def test_cores_of_all_instruction_sets_share_a_process():
    """Documentation tools import every module; a second core must not abort the interpreter."""
    code = (
        "import importlib; from diffsim.core import compiled\n"
        "for name in compiled.available(): importlib.import_module(f'diffsim._core_{name}')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
