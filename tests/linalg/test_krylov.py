"""Krylov solvers in a program of their own: Python reaches them through bodies alone."""

from pathlib import Path

import pytest

from tests.linalg.programs import compiled, needs_gxx, said

pytestmark = needs_gxx


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    return compiled("krylov", tmp_path_factory.mktemp("krylov"))


def test_krylov_solvers(program):
    assert said(program) == (0, "right\n")


def test_a_wrong_product_is_seen(program):
    code, text = said(program, "0.01")
    assert code == 1 and text.startswith("wrong: ")
