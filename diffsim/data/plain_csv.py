"""Large CSV files that hold nothing but numbers, read as one array."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from diffsim.core.progress import say_stage

SMALLEST = 1 << 18  # bytes, from which on it is worth a second way


def plain_numbers(
    path: Path, delimiter: str, skipped: int, num_columns: int
) -> NDArray[np.float64] | None:
    """All cells of a file, (num_rows, num_columns); None where one is no finite number.

    A file with blank lines, quotes, missing cells, labels or an encoding of its own is for the
    reader that can name row and column.

    Args:
        path: CSV file.
        delimiter: Between its cells.
        skipped: Lines before the first row.
        num_columns: Cells of a row.
    """
    say_stage(f"reading {path.name}")
    try:
        cells = np.loadtxt(
            path,
            delimiter=delimiter,
            skiprows=skipped,
            comments=None,
            ndmin=2,
            encoding="utf-8",
        )
    except (ValueError, UnicodeError):
        return None
    if cells.shape[1] != num_columns or not np.isfinite(cells).all():
        return None
    return cells if len(cells) == _count_lines(path) - skipped else None


def _count_lines(path: Path) -> int:
    count, last = 0, b"\n"
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            count += block.count(b"\n")
            last = block[-1:]
    return count + (last != b"\n")
