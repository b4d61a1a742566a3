"""Where the measured data and reference vectors are; tests skip with a reason when they are not."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def data_folder(name: str) -> Path:
    """Folder ``name`` of DIFFSIM_DATA (default: shared/data beside the repository).

    Some sets carry no license: their folder holds the script that makes the files, ``make_csv.py``.
    """
    base = Path(os.environ.get("DIFFSIM_DATA", ROOT.parent / "shared/data"))
    folder = base / name
    if not folder.is_dir():
        pytest.skip(f"no reference data at {folder}; set DIFFSIM_DATA to the folder that holds it")
    if (folder / "make_csv.py").exists() and not any(folder.glob("*.csv")):
        pytest.skip(f"{folder} holds no CSV files yet; make_csv.py there makes them from a clone")
    return folder
