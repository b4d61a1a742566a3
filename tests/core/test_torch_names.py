"""Private names of PyTorch stand in one file, which says with which version they were tried."""

import re
from pathlib import Path

import torch

import diffsim
from diffsim.core import torch_names

PRIVATE = re.compile(r"\btorch\._[A-Za-z]|\._C\b|forward_ad\._|_functorch|_opoverload|_backend_fns")


def test_private_names_of_pytorch_stand_in_one_file():
    package = Path(diffsim.__file__).parent
    found = [
        f"{path.relative_to(package)}: {line.strip()}"
        for path in sorted(package.rglob("*.py"))
        if path.name != "torch_names.py"
        for line in path.read_text().splitlines()
        if PRIVATE.search(line)
    ]
    assert not found


def test_the_version_is_the_one_they_were_tried_with():
    """Where it is not: run tests/core and tests/test_transformations.py, then write it down."""
    assert torch.__version__.startswith(torch_names.TRIED + ".")
