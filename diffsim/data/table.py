"""Recorded tables: rows and cells of CSV files, refused with file, row and column where they
cannot be right; their columns by name, numbers with their gaps, clocks, labels.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from datetime import datetime, time
from functools import cached_property
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import did_you_mean
from diffsim.data.formats import Columns, is_container, left_out_of, read_columns
from diffsim.data.plain_csv import SMALLEST, plain_numbers

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
MAKER = "make_csv.py"  # beside recordings that may not be copied: it makes them from the original
MAX_COLUMNS = 10_000
MAX_LINE = 4_000_000  # characters
MISSING = ("nan", "na", "n/a", "#n/a", "n.a.", "null", "none", "-", "--", "---", "----")
_OTHER_TIME = re.compile(r"^(t|time|timestamp|time_?ms|time_?us|t_s|t_ms|seconds)$", re.IGNORECASE)


def delimiter_of(header: str) -> str:
    """Delimiter of a file by its header line: a semicolon or tab if there is one, else a comma."""
    return next((mark for mark in (";", "\t") if mark in header), ",")


_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d*),(\d+(?:[eE][-+]?\d+)?\s*)$")


@contextmanager
def open_text(path: Path) -> Iterator[TextIO]:
    """A text file as UTF-8, UTF-16 with a mark, or else as Windows writes it."""
    with path.open("rb") as file:
        start = file.read(2)
        is_utf16 = start in (b"\xff\xfe", b"\xfe\xff")
        try:
            (start + file.read()).decode("utf-16" if is_utf16 else "utf-8")
            encoding = "utf-16" if is_utf16 else "utf-8-sig"
        except UnicodeDecodeError:
            encoding = "cp1252"
    with path.open(newline="", encoding=encoding, errors="replace") as text:
        yield text


@contextmanager
def open_table(
    path: Path, what: str, *, header_line: int = 1, first_line: int | None = None
) -> Iterator[tuple[list[str], Iterator[tuple[int, list[str]]]]]:
    """Header and numbered rows of a CSV file; blank lines are skipped.

    Cells are divided by semicolons or tabs if the header is, else by commas; where they are not
    divided by commas, a decimal comma is read as a point.

    Args:
        path: CSV file to be read.
        what: What it should be, for the message, such as "recording".
        header_line: Line with the names of the columns, from 1.
        first_line: Line of the first sample; by default the one after the header.

    Raises:
        FileNotFoundError: no such file; the message lists the CSV files beside it.
        ValueError: no header, too many columns, a column occurs twice, a row has another number of
            cells, or a line is no CSV.
    """
    if not path.is_file():
        beside = sorted(p.name for p in path.parent.glob("*.csv")) if path.parent.is_dir() else []
        there = f"; that folder has {', '.join(beside)}" if beside else ""
        if (maker := path.parent / MAKER).is_file():
            there += f"; files of this data set are made by `python {maker}`"
        raise FileNotFoundError(f"{path}: no such {what}{there}{did_you_mean(path.name, beside)}")
    skipped = (first_line or header_line + 1) - 1
    with open_text(path) as file:
        for _ in range(header_line - 1):
            next(file, "")
        header, mark = _header(path, file, header_line)
        for _ in range(skipped - header_line):
            next(file, "")
        rows = csv.reader(file, delimiter=mark)
        yield header, _number_rows(path, header, rows, skipped, mark != ",")


def _header(path: Path, file: TextIO, line: int) -> tuple[list[str], str]:
    """Names of the columns, and the delimiter."""
    where = f"{path}, row {line}"
    first = file.readline(MAX_LINE + 1)
    mark = delimiter_of(first)
    if len(first) > MAX_LINE or (count := first.count(mark) + 1) > MAX_COLUMNS:
        size = f"{count:,} columns" if len(first) <= MAX_LINE else f"more than {MAX_LINE:,} letters"
        raise ValueError(
            f"{where}: a header must have at most {MAX_COLUMNS:,} columns, got {size}; is a row of "
            "this file a column of the table?"
        )
    try:
        header = [name.strip() for name in next(csv.reader([first], delimiter=mark), [])]
    except csv.Error as error:
        raise ValueError(f"{where}: not CSV: {error}") from None
    if not header:
        raise ValueError(f"{path}: the file is empty; expected a header line with time_s")
    counts = Counter(name for name in header if name)
    if repeated := sorted(name for name, count in counts.items() if count > 1):
        raise ValueError(f"{path}: column {repeated[0]!r} occurs more than once in the header")
    return header, mark


def _rows(path: Path, rows: Iterator[list[str]], before: int) -> Iterator[list[str]]:
    """Rows; one that is no CSV is refused with its line."""
    while True:
        try:
            row = next(rows)
        except StopIteration:
            return
        except csv.Error as error:
            line: int = before + rows.line_num  # type: ignore[attr-defined]
            raise ValueError(f"{path}, row {line}: not CSV: {error}") from None
        yield row


def _number_rows(
    path: Path, header: list[str], rows: Iterator[list[str]], before: int, comma_is_point: bool
) -> Iterator[tuple[int, list[str]]]:
    for row in _rows(path, rows, before):
        line: int = before + rows.line_num  # type: ignore[attr-defined]
        if not any(cell.strip() for cell in row):
            continue  # blank line, usually the last
        if len(row) == len(header) + 1 and not row[-1].strip():
            row = row[:-1]  # loggers end a row with a delimiter
        if len(row) != len(header):
            raise ValueError(
                f"{path}, row {line}: {len(row)} cells, but the header has {len(header)} "
                "columns; a cell without a value must still have its comma"
            )
        if comma_is_point:
            row = [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in row]
        yield line, row


def all_numbers(path: Path, header_line: int, skipped: int, count: int) -> Array | None:
    """Cells of a large file of numbers alone, (num_rows, num_columns); None of any other file."""
    with open_text(path) as file:
        if file.encoding.lower() not in ("utf-8", "utf-8-sig"):
            return None
        for _ in range(header_line - 1):
            next(file, "")
        mark = delimiter_of(file.readline(MAX_LINE))
    return plain_numbers(path, mark, skipped, count)


def time_column(path: Path, header: list[str]) -> int:
    """Index of ``time_s``; a column that looks like it is named in the message."""
    if "time_s" not in header:
        close = [name for name in header if _OTHER_TIME.match(name)]
        hint = f"; column {close[0]!r} looks like it: rename it, in seconds" if close else ""
        raise ValueError(
            f"{path}: column time_s is missing{hint or did_you_mean('time_s', header)}; "
            f"the file has {', '.join(header)}"
        )
    return header.index("time_s")


def parse_time(path: Path, line: int, column: str, cell: str, before: float | None) -> float:
    """A time [s], later than the one before."""
    now = parse_number(path, line, column, cell)
    if math.isnan(now):
        raise ValueError(f"{path}, row {line}, column {column}: time is missing")
    if before is not None and now <= before:
        raise ValueError(
            f"{path}, row {line}, column {column}: time must increase, got "
            f"{now:g} s after {before:g} s; remove repeated rows or sort the file"
        )
    return now


def parse_number(
    path: Path, line: int, column: str, cell: str, *, missing: str = "nothing was measured"
) -> float:
    """One cell; an empty one or one of ``MISSING`` is NaN, else it must be a finite number."""
    text = cell.strip()
    if text == "" or text.lower() in MISSING:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        comma = "; use a decimal point" if re.fullmatch(r"-?\d+,\d+", text) else ""
        raise ValueError(
            f"{path}, row {line}, column {column}: {text!r} is not a number{comma}; "
            f"leave the cell empty where {missing}"
        ) from None
    if not math.isfinite(value):
        raise ValueError(f"{path}, row {line}, column {column}: {text!r} is not a finite number")
    return value


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
        left_out: What the file holds, or lost, and the table does not have, a sentence each.
    """

    def __init__(
        self, path: Path, what: str, *, header_line: int = 1, first_line: int | None = None
    ):
        self.path = path
        self._numbers: dict[str, Array] = {}
        self.used: set[str] = set()
        self._cells: list[list[str]] = []
        self._plain: Array | None = None
        self._layout = (header_line, first_line)
        self._arrays: Columns = read_columns(path) if is_container(path) else {}
        self.left_out = left_out_of(path) if self._arrays else []
        if self._arrays:
            self.header = list(self._arrays)
            self.lines = list(range(1, 1 + len(self._arrays[self.header[0]])))
            return
        with open_table(path, what, header_line=header_line, first_line=first_line) as (head, rows):
            self.header = head
            skipped = (first_line or header_line + 1) - 1
            if path.stat().st_size >= SMALLEST:
                self._plain = all_numbers(path, header_line, skipped, len(head))
            if self._plain is not None:
                self.lines = list(range(skipped + 1, skipped + 1 + len(self._plain)))
                return
            numbered = list(rows)
        if not numbered:
            raise ValueError(f"{path}: no rows below the header; was the export cut short?")
        self.lines = [line for line, _ in numbered]
        self._cells = [row for _, row in numbered]

    @classmethod
    def of_columns(cls, path: Path, columns: Columns, left_out: Sequence[str] = ()) -> Table:
        """A table of columns that were read already, (num_rows,) each."""
        made = cls.__new__(cls)
        made.path, made.used, made.header = path, set(), list(columns)
        made.left_out = list(left_out)
        made._numbers, made._cells, made._arrays, made._plain = {}, [], columns, None
        made._layout = (1, None)
        made.lines = list(range(1, 1 + len(next(iter(columns.values())))))
        return made

    def twin(self) -> Table:
        """The same table; what is asked of it does not count as used."""
        made = copy(self)
        made.used = set(self.used)
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
        if name not in self._numbers and self._plain is not None:
            self.require(name)
            self._numbers[name] = np.ascontiguousarray(self._plain[:, self.header.index(name)])
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
            name: self._plain is not None
            or self._is_array(name)
            or _all_numbers(self._column(name))
            for name in self.header
        }

    def _is_array(self, name: str) -> bool:
        return name in self._arrays and self._arrays[name].dtype.kind in "biuf"

    def _column(self, name: str) -> list[str]:
        if name in self._arrays:
            return [str(cell).strip() for cell in self._arrays[name].tolist()]
        at = self.header.index(name)
        if self._plain is not None and not self._cells:  # as they are written: 007 is no 7
            header_line, first_line = self._layout
            with open_table(self.path, "table", header_line=header_line, first_line=first_line) as (
                _,
                rows,
            ):
                self._cells = [row for _, row in rows]
        return [row[at].strip() for row in self._cells]

    def seconds(self, column: str | None, factor: float | None, step: float | None) -> Array:
        """Clock of the rows [s]; NaN where a stamp is missing.

        Args:
            column: Column with the time; None: ``time_s``.
            factor: Seconds in its unit; None: it holds times of day or dates.
            step: Seconds between rows, or for each count of the column.

        Raises:
            ValueError: no such column, or a cell that is no time.
        """
        if step is not None and column is None:
            return step * np.arange(len(self), dtype=np.float64)
        name = column or self.header[time_column(self.path, self.header)]
        if factor is None:
            return _clock(self.path, self.lines, name, self.texts(name))
        now = self.numbers(name)
        scale = step or factor
        return scale * now if scale != 1.0 else now


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
