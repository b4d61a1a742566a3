"""Twins of published recordings: the same files and description, what is hidden known."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffsim.data.study import Study
from diffsim.data.study_file import load_study
from diffsim.systems import published

FOLDER = Path(published.__file__).parent


def stated_of(name: str) -> dict[str, Any]:
    """What the study of a published data set states."""
    stated: dict[str, Any] = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    return stated


def write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """A CSV of columns by name, to six decimals as the recordings have them."""
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="", fmt="%.6f")


def load_twin(folder: Path, stated: Mapping[str, Any]) -> Study:
    """The study of a description whose recordings lie in a folder."""
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump({**stated, "data": str(folder)}, sort_keys=False))
    return load_study(path)
