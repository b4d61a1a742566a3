"""Folder of the measured data: ``DIFFSIM_DATA``, else a folder in or beside the project."""

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[2]


def data_candidates() -> list[Path]:
    """Folders where data is looked for, first one first; ``DIFFSIM_DATA`` excludes the others."""
    if chosen := os.environ.get("DIFFSIM_DATA"):
        return [Path(chosen).expanduser()]
    return [Path("data").absolute(), PROJECT / "shared/data", PROJECT.parent / "shared/data"]


def data_folder() -> Path | None:
    """The first candidate that exists; None where there is none."""
    return next((path for path in data_candidates() if path.is_dir()), None)
