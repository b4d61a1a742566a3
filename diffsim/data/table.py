"""Rows and cells of CSV files, refused with file, row and column where they cannot be right."""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from diffsim.core.check import did_you_mean

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
