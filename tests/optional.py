"""Packages that tests may lack, or that cost seconds: asked for without loading them."""

import importlib.util

import pytest


def needs(module: str, *, reason: str = "it is an extra") -> None:
    """Skip the test module that says so where a package is not installed.

    Other than ``pytest.importorskip`` it leaves loading to the tests: collecting all of them loads
    nothing that one of them needs.
    """
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed: {reason}", allow_module_level=True)
