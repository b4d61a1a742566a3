"""Rows of 3x3 blocks in a program of their own, for each instruction set that the processor has."""

from pathlib import Path

import pytest

from tests.linalg.programs import compiled, needs_gxx, said

CPU = Path("/proc/cpuinfo")
NEEDS = {"x86-64": "sse2", "x86-64-v3": "avx2", "x86-64-v4": "avx512dq"}

pytestmark = needs_gxx


@pytest.fixture(scope="module", params=NEEDS)
def program(request, tmp_path_factory) -> Path:
    flags = CPU.read_text().split() if CPU.exists() else []
    if NEEDS[request.param] not in flags:
        pytest.skip(f"the processor has no {NEEDS[request.param]}")
    return compiled("blocks", tmp_path_factory.mktemp("blocks"), f"-march={request.param}")


def test_rows_of_blocks(program):
    assert said(program) == (0, "right\n")


def test_scales_that_16_bits_do_not_hold_are_seen(program):
    assert said(program, "-0.01") == (1, "wrong: a rounded number\n")
