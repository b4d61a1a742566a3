"""Folders beside the package: measured data, and the scripts of examples and of training."""

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType

PROJECT = Path(__file__).resolve().parents[2]
# A checkout has the scripts beside the package, a wheel in it (setup.py copies them).
SCRIPTS = PROJECT if (PROJECT / "pyproject.toml").is_file() else PROJECT / "diffsim" / "_scripts"


def import_script(name: str) -> ModuleType:
    """A module of ``examples``, ``labs`` or ``rl``, which the library itself never imports.

    Args:
        name: Its full name, such as "examples.demo".

    Raises:
        FileNotFoundError: the scripts are neither in a checkout nor in the installed package.
    """
    place = SCRIPTS.joinpath(*name.split("."))
    if not (place.is_dir() or place.with_suffix(".py").is_file()):
        raise FileNotFoundError(
            f"{name} is missing: {place} does not exist; install the wheel anew, or clone the "
            "repository and install it with pip install -e ."
        )
    if str(SCRIPTS) not in sys.path:
        sys.path.insert(0, str(SCRIPTS))
    return importlib.import_module(name)


def data_candidates() -> list[Path]:
    """Folders where data is looked for, first one first; ``DIFFSIM_DATA`` excludes the others."""
    if chosen := os.environ.get("DIFFSIM_DATA"):
        return [Path(chosen).expanduser()]
    return [Path("data").absolute(), PROJECT / "shared/data", PROJECT.parent / "shared/data"]


def data_folder() -> Path | None:
    """The first candidate that exists; None where there is none."""
    return next((path for path in data_candidates() if path.is_dir()), None)
