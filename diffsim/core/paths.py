"""Folders beside the package: measured data, and the scripts of examples and of training."""

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]
# A checkout has the scripts beside the package, a wheel in it (setup.py copies them).
SCRIPTS = PROJECT if (PROJECT / "pyproject.toml").is_file() else PROJECT / "diffsim" / "_scripts"


def data_candidates() -> list[Path]:
    """Folders where data is looked for, first one first; ``DIFFSIM_DATA`` excludes the others."""
    if chosen := os.environ.get("DIFFSIM_DATA"):
        return [Path(chosen).expanduser()]
    return [Path("data").absolute(), PROJECT / "shared/data", PROJECT.parent / "shared/data"]


def data_folder() -> Path | None:
    """The first candidate that exists; None where there is none."""
    return next((path for path in data_candidates() if path.is_dir()), None)
