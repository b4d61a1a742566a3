"""Where the measured data and reference vectors are; tests skip with a reason when they are not."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def data_folder(name: str) -> Path:
    """Folder ``name`` of DIFFSIM_DATA (default: shared/data beside the repository)."""
    base = Path(os.environ.get("DIFFSIM_DATA", ROOT.parent / "shared/data"))
    folder = base / name
    if not folder.is_dir():
        pytest.skip(f"no reference data at {folder}; set DIFFSIM_DATA to the folder that holds it")
    return folder
