"""Columns of recorded files by name: numbers with their gaps, clocks, labels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import datetime, time
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import did_you_mean
from diffsim.data.formats import Columns, is_container, read_columns
from diffsim.data.table import MISSING, open_table, parse_number, time_column

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


class Table:
    """A recorded file in memory; numbers are read when a column is asked for.

    Args:
        path: CSV file, or ``FILE#PART`` of a format of ``diffsim.data.formats``.
        what: What it should be, for messages, such as "run".
        header_line: Line with the names of the columns, from 1.
        first_line: Line of the first sample; by default the one after the header.

    Attributes:
        header: Names of the columns.
        lines: Line of each row in the file.
        used: Columns that were asked for.
    """

    def __init__(
        self, path: Path, what: str, *, header_line: int = 1, first_line: int | None = None
    ):
        self.path = path
        self._numbers: dict[str, Array] = {}
        self.used: set[str] = set()
        self._cells: list[list[str]] = []
        self._arrays: Columns = read_columns(path) if is_container(path) else {}
        if self._arrays:
            self.header = list(self._arrays)
            self.lines = list(range(1, 1 + len(self._arrays[self.header[0]])))
            return
        with open_table(path, what, header_line=header_line, first_line=first_line) as (head, rows):
            self.header = head
            numbered = list(rows)
        if not numbered:
            raise ValueError(f"{path}: no rows below the header; was the export cut short?")
        self.lines = [line for line, _ in numbered]
        self._cells = [row for _, row in numbered]

    @classmethod
    def of_columns(cls, path: Path, columns: Columns) -> Table:
        """A table of columns that were read already, (num_rows,) each."""
        made = cls.__new__(cls)
        made.path, made.used, made.header = path, set(), list(columns)
        made._numbers, made._cells, made._arrays = {}, [], columns
        made.lines = list(range(1, 1 + len(next(iter(columns.values())))))
        return made

    def __len__(self) -> int:
        return len(self.lines)

    def require(self, name: str) -> None:
        """Refuse a column that the file does not have."""
        if name not in self.header:
            raise ValueError(
                f"{self.path}: column {name} is missing{did_you_mean(name, self.header)}; "
                f"the file has {', '.join(self.header)}"
            )

    def texts(self, name: str) -> list[str]:
        """Cells of a column, without blanks around them."""
        self.require(name)
        self.used.add(name)
        return self._column(name)

    def numbers(self, name: str) -> Array:
        """Numbers of a column, (num_rows,); NaN where a cell is empty.

        Raises:
            ValueError: no such column, or a cell that is not a number; the message names its row.
        """
        if name not in self._numbers and self._is_array(name):
            values = self._arrays[name].astype(np.float64)
            if np.isinf(values).any():
                line = self.lines[int(np.argmax(np.isinf(values)))]
                raise ValueError(f"{self.path}, row {line}, column {name}: not a finite number")
            self._numbers[name] = values
        if name not in self._numbers:
            cells = self.texts(name)
            try:
                values = np.array([float(c) if c else math.nan for c in cells])
            except ValueError:
                values = np.array([math.inf])
            if np.isinf(values).any():  # the slow way finds the row
                values = np.array(
                    [
                        parse_number(self.path, line, name, cell)
                        for line, cell in zip(self.lines, cells, strict=True)
                    ]
                )
            self._numbers[name] = values
        self.used.add(name)
        return self._numbers[name]

    def values(self, name: str) -> NDArray[Any]:
        """A column as it is: numbers, (num_rows,), or text."""
        if self._is_array(name):
            self.used.add(name)
            return self._arrays[name]
        return self.numbers(name) if self.is_number[name] else np.array(self.texts(name))

    def columns(self) -> Columns:
        """All columns by name, each (num_rows,): numbers, or text."""
        return {name: self.values(name) for name in self.header}

    @cached_property
    def is_number(self) -> dict[str, bool]:
        """Whether a column holds numbers, by name; one without any cell does not."""
        return {
            name: self._is_array(name) or _all_numbers(self._column(name)) for name in self.header
        }

    def _is_array(self, name: str) -> bool:
        return name in self._arrays and self._arrays[name].dtype.kind in "biuf"

    def _column(self, name: str) -> list[str]:
        if name in self._arrays:
            return [str(cell).strip() for cell in self._arrays[name].tolist()]
        at = self.header.index(name)
        return [row[at].strip() for row in self._cells]

    def seconds(self, column: str | None, factor: float | None, step: float | None) -> Array:
        """Clock of the rows [s].

        Args:
            column: Column with the time; None: ``time_s``.
            factor: Seconds in its unit; None: it holds times of day or dates.
            step: Seconds between rows, or for each count of the column.

        Raises:
            ValueError: no such column, or a time is missing.
        """
        if step is not None and column is None:
            return step * np.arange(len(self), dtype=np.float64)
        name = column or self.header[time_column(self.path, self.header)]
        if factor is None:
            return _clock(self.path, self.lines, name, self.texts(name))
        now = self.numbers(name)
        if np.isnan(now).any():
            line = self.lines[int(np.argmax(np.isnan(now)))]
            raise ValueError(f"{self.path}, row {line}, column {name}: time is missing")
        scale = step or factor
        return scale * now if scale != 1.0 else now


def require_increasing(table: Table, rows: Rows, now: Array, column: str) -> None:
    """Refuse rows whose times do not increase, with the row at which they do not."""
    back = np.diff(now) <= 0.0
    if back.any():
        at = int(np.argmax(back)) + 1
        raise ValueError(
            f"{table.path}, row {table.lines[rows[at]]}, column {column}: time must increase, got "
            f"{now[at]:g} s after {now[at - 1]:g} s; remove repeated rows or sort the file, or "
            "split it into runs"
        )


def as_label(cell: str) -> float | int | str:
    """A cell as the number that it holds, a whole one where it is whole, or as text."""
    try:
        value = float(cell)
    except ValueError:
        return cell
    return int(value) if math.isfinite(value) and value == int(value) else value


def _all_numbers(cells: Sequence[str]) -> bool:
    filled = [c for c in cells if c and c.lower() not in MISSING]
    try:
        return bool(filled) and all(math.isfinite(float(c)) for c in filled)
    except ValueError:
        return False


def _clock(path: Path, lines: list[int], column: str, cells: list[str]) -> Array:
    """Seconds since the first row, of times of day (12:30:05.250) or dates with a time."""
    out = []
    for line, cell in zip(lines, cells, strict=True):
        try:
            if ":" in cell and "-" not in cell and "/" not in cell:
                at = time.fromisoformat(_six_digits(cell))
                seconds = at.hour * 3600.0 + at.minute * 60.0 + at.second + at.microsecond * 1e-6
            else:
                seconds = datetime.fromisoformat(_six_digits(cell).replace("Z", "")).timestamp()
        except ValueError:
            raise ValueError(
                f"{path}, row {line}, column {column}: {cell!r} is no time; expected 12:30:05.25 "
                "or 2024-05-01 12:30:05.25"
            ) from None
        out.append(seconds)
    return np.array(out) - out[0]


def _six_digits(cell: str) -> str:
    """The cell with six digits after the point: Python before 3.11 reads three or six only."""
    head, point, tail = cell.partition(".")
    return head + point + tail[:6].ljust(6, "0") if point else cell
