"""Recordings in a format of their own: a line for each value, ``time;name;value``."""

from pathlib import Path

import numpy as np

from diffsim.data.formats.columns import Columns


def parts(path: Path) -> list[str]:
    """One table."""
    return [""]


def read(path: Path, part: str) -> Columns:
    """Columns by name."""
    found: dict[str, list[float]] = {}
    times: dict[str, None] = {}
    for line in path.read_text().splitlines():
        time, name, value = line.split(";")
        times[time] = None
        found.setdefault(name, []).append(float(value))
    return {"time_s": np.array([float(t) for t in times])} | {
        name: np.array(values) for name, values in found.items()
    }
