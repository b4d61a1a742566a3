"""Recorded tables: rows and cells of CSV files, refused with file, row and column where they
cannot be right; their columns by name, numbers with their gaps, clocks, labels.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, compress, islice
from pathlib import Path
from typing import Any, TextIO
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from diffsim.core.arrays import Array, IntArray
from diffsim.core.check import did_you_mean
from diffsim.core.progress import say_stage
from diffsim.data.dates import seconds_of_stamps
from diffsim.data.formats import Columns, is_container, left_out_of, read_columns
from diffsim.data.formats.columns import MAX_COLUMNS, MOST_ENTRIES, text_of
from diffsim.data.side_by_side import runs_beside

Rows = IntArray
MAKER = "make_csv.py"  # beside recordings that may not be copied: it makes them from the original
NO_ROW = ("", "#")  # begins of lines between names and numbers that hold neither
BLOCK = 1 << 20  # letters that are looked at together
MAX_LINE = 4_000_000  # characters
ROWS_SHOWN = 20_000  # rows after which reading says how far it is
MISSING = ("nan", "na", "n/a", "#n/a", "n.a.", "null", "none", "-", "--", "---", "----")
_OTHER_TIME = re.compile(r"^(t|time|timestamp|time_?ms|time_?us|t_s|t_ms|seconds)$", re.IGNORECASE)


def delimiter_of(header: str, sample: str = "") -> str:
    """Delimiter of a file by its header line: a semicolon or tab if there is one, else a comma; a
    blank where the first sample is several numbers with nothing but blanks between them."""
    found = next((mark for mark in (";", "\t") if mark in header), ",")
    cells = sample.split()
    is_blank = found == "," and len(cells) > 1 and all(map(is_number, cells))
    return " " if is_blank else found


def cells_of(line: str, mark: str) -> list[str]:
    """Cells of a line, without blanks around them; a header between blanks may begin with #."""
    if mark == " ":
        return line.lstrip("#% \t").split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=mark), [])]


_LIST_MARKS = re.compile(r"[\[\](),;]")
#: Empty cells, and those that say so, between delimiters or at an end of a line
_MISSING_CELL = {
    mark: re.compile(
        rf"(?:^|(?<={mark})) *(?:{'|'.join(map(re.escape, MISSING))})? *(?={mark}|\r?$)",
        re.IGNORECASE | re.MULTILINE,
    )
    for mark in (",", ";", "\t")
}
GROUPED_DIGITS = re.compile(r"[-+]?\d{1,3}([.,' ]\d{3})+([.,]\d+)?")  # 1.234,5
_LONE_COMMA = re.compile(r",(?!\d)")  # no decimal comma: what it is, is told cell by cell
#: Words of a file that is read as Cyrillic; western accents, too, but these touch plain letters
_CYRILLIC = re.compile("[А-яЁё]{3}")
_ACCENTED = re.compile("[A-Za-z][А-яЁё]|[А-яЁё][A-Za-z]")
_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d*),(\d+(?:[eE][-+]?\d+)?\s*)$")


@contextmanager
def open_text(path: Path) -> Iterator[TextIO]:
    """A text file as UTF-8, UTF-16 with a mark, or else as Windows writes it."""
    with path.open("rb") as file:
        is_utf16 = file.read(2) in (b"\xff\xfe", b"\xfe\xff")
    encoding = "utf-16" if is_utf16 else "utf-8-sig"
    try:
        with path.open(newline="", encoding=encoding) as text:
            while text.read(BLOCK):  # a large file as a whole would take twice its size
                pass
    except UnicodeDecodeError:
        with path.open(encoding="cp1251", errors="replace") as text:
            words = text.read(BLOCK)
        is_western = bool(_ACCENTED.search(words)) or not _CYRILLIC.search(words)
        encoding = "cp1252" if is_western else "cp1251"
    with path.open(newline="", encoding=encoding, errors="replace") as text:
        yield text


@contextmanager
def open_table(
    path: Path, what: str
) -> Iterator[tuple[list[str], Iterator[tuple[int, list[str]]]]]:
    """Header and numbered rows of a CSV file; blank lines are skipped.

    Cells are divided by semicolons or tabs if the header is, else by commas; where they are not
    divided by commas, a decimal comma is read as a point.

    Args:
        what: What it should be, for the message, such as "recording".

    Raises:
        FileNotFoundError: no such file; the message lists the CSV files beside it.
        ValueError: no header, too many columns, a column occurs twice, a row has another number of
            cells, or a line is no CSV.
    """
    with _open_lines(path, what, 1, None, ()) as (header, mark, before, lines):
        rows = csv.reader(lines, delimiter=mark, skipinitialspace=mark == " ")
        yield header, _number_rows(path, header, rows, before, mark != ",")


@contextmanager
def _open_lines(
    path: Path, what: str, header_line: int, first_line: int | None, columns: Sequence[str]
) -> Iterator[tuple[list[str], str, int, Iterable[str]]]:
    """Header, delimiter, number of lines before the first sample, and the lines from there on."""
    _require_file(path, what)
    before = (first_line or header_line + 1) - 1
    with open_text(path) as file:
        header, mark, lines = _header(path, file, header_line, before, columns)
        yield header, mark, before, lines


def _require_file(path: Path, what: str) -> None:
    if path.is_file():
        return
    beside = sorted(p.name for p in path.parent.glob("*.csv")) if path.parent.is_dir() else []
    there = f"; that folder has {', '.join(beside)}" if beside else ""
    if (maker := path.parent / MAKER).is_file():
        there += f"; files of this data set are made by `python {maker}`"
    raise FileNotFoundError(f"{path}: no such {what}{there}{did_you_mean(path.name, beside)}")


def _header(
    path: Path, file: TextIO, line: int, skipped: int, names: Sequence[str]
) -> tuple[list[str], str, Iterable[str]]:
    """Names of the columns, the delimiter, and the lines of samples.

    Args:
        path: The file, for messages.
        file: The same, opened.
        line: Line of the names, from 1; 0: the file has none.
        skipped: Lines before the first sample.
        names: Names in place of the file's; empty: its own, or column_1, column_2, ...
    """
    before = [file.readline(MAX_LINE + 1) for _ in range(skipped)]
    first = before[line - 1] if line else file.readline(MAX_LINE + 1)
    where = f"{path}, row {line or skipped + 1}"
    samples = [file.readline()] if line else [first]
    while line and samples[-1] and samples[-1].lstrip()[:1] in NO_ROW:
        samples.append(file.readline())  # a remark below the names tells no delimiter
    mark = delimiter_of(first, samples[-1] or samples[0])
    if len(first) > MAX_LINE or (count := first.count(mark) + 1) > MAX_COLUMNS:
        size = f"{count:,} columns" if len(first) <= MAX_LINE else f"more than {MAX_LINE:,} letters"
        raise ValueError(
            f"{where}: a header must have at most {MAX_COLUMNS:,} columns, got {size}; is a row of "
            "this file a column of the table?"
        )
    try:
        header = cells_of(first, mark)
    except csv.Error as error:
        raise ValueError(f"{where}: not CSV: {error}") from None
    if not header:
        raise ValueError(f"{path}: the file is empty; expected a header line with time_s")
    if names and path.suffix == ".lvm":
        header = header[: len(names)]  # a comment may follow
    if names and len(names) != len(header):
        raise ValueError(
            f"{where}: {len(header)} cells, but `columns` names {len(names)}: {', '.join(names)}"
        )
    if names or not line:
        header = list(names) or [f"column_{k}" for k in range(1, 1 + len(header))]
    counts = Counter(name for name in header if name)
    if repeated := sorted(name for name, count in counts.items() if count > 1):
        raise ValueError(
            f"{path}: column {repeated[0]!r} occurs more than once in the header; `columns` of "
            "`table` gives names of your own"
        )
    return header, mark, chain(samples, file)


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
    path: Path,
    header: list[str],
    rows: Iterator[list[str]],
    before: int,
    comma_is_point: bool,
    passed: list[str] | None = None,
) -> Iterator[tuple[int, list[str]]]:
    """Rows with their lines; a logger's words between rows of numbers are left out, and added to
    ``passed``."""
    held: list[tuple[int, list[str]]] = []  # until a first cell says what this column holds
    are_numbers: bool | None = None
    for row in _rows(path, rows, before):
        line: int = before + rows.line_num  # type: ignore[attr-defined]
        if not any(cell.strip() for cell in row):
            continue  # blank line, usually the last
        if len(row) == len(header) + 1 and not row[-1].strip():
            row = row[:-1]  # loggers end a row with a delimiter
        if len(row) == len(header) + 1 and path.suffix == ".lvm":
            row = row[:-1]  # a comment
        first = row[0].strip()
        is_remark = first.startswith("#") and first.lower() not in MISSING  # of the logger
        if is_remark and (are_numbers or len(row) != len(header)):
            continue
        if passed is not None and are_numbers and _are_words(row, header):
            passed.append(f"row {line}, {' '.join(row).strip()[:40]!r}")
            continue
        if len(row) != len(header):
            last = "" if next(rows, None) else "; it is the last one: was the file cut off?"
            raise ValueError(
                f"{path}, row {line}: {len(row)} cells, but the header has {len(header)} "
                "columns; a cell without a value must still have its comma, a line of text begin "
                f"with #{last}"
            )
        if comma_is_point:
            row = [_DECIMAL_COMMA.sub(r"\1.\2", c) if "," in c else c for c in row]
        if is_remark and are_numbers is None:
            held.append((line, row))
            continue
        if are_numbers is None:
            are_numbers = first.lower() in ("", *MISSING) or first[0] in "+-.,0123456789"
            yield from () if are_numbers else held
        yield line, row
    if are_numbers is None:
        yield from held  # every cell of it begins like that: "#12" may be a name


def _are_words(row: Sequence[str], header: Sequence[str]) -> bool:
    """Whether a line has fewer cells than a row, and no number: OK, or ERR: timeout."""
    return len(row) < len(header) and not any(is_number(cell.strip()) for cell in row)


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


def parse_number(
    path: Path, line: int, column: str, cell: str, *, missing: str = "nothing was measured"
) -> float:
    """One cell; an empty one or one of ``MISSING`` is NaN, else it must be a finite number."""
    text = cell.strip()
    if text == "" or text.lower() in MISSING:
        return math.nan
    try:
        value = float("" if "_" in text else text)  # Python alone takes 1_000
    except ValueError:
        comma = "; use a decimal point" if re.fullmatch(r"-?\d+,\d+", text) else ""
        if GROUPED_DIGITS.fullmatch(text):
            comma = "; leave marks of thousands out"
        raise ValueError(
            f"{path}, row {line}, column {column}: {text!r} is not a number{comma}; "
            f"leave the cell empty where {missing}"
        ) from None
    if not math.isfinite(value):
        raise ValueError(
            f"{path}, row {line}, column {column}: {text!r} is not a finite number; leave the cell "
            f"empty where {missing}"
        )
    return value


def read_numbers(path: Path, names: Sequence[str]) -> dict[str, Array]:
    """Columns of numbers by name; an empty cell is NaN.

    Raises:
        FileNotFoundError, ValueError: no file, a column that is missing, or a cell that is no
            number.
    """
    values: dict[str, list[float]] = {name: [] for name in names}
    with open_table(path, "recording") as (header, rows):
        for name in names:
            if name not in header:
                raise ValueError(
                    f"{path}: column {name} is missing{did_you_mean(name, header)}; "
                    f"the file has {', '.join(header)}"
                )
        for line, row in rows:
            for name in names:
                values[name].append(parse_number(path, line, name, row[header.index(name)]))
    return {name: np.array(column) for name, column in values.items()}


class Table:
    """A recorded file in memory; numbers are read when a column is asked for.

    Args:
        path: CSV file, or ``FILE#PART`` of a format of ``diffsim.data.formats``, or of a CSV file
            with runs side by side: their label.
        what: What it should be, for messages, such as "run".
        header_line: Line with the names of the columns, from 1; 0: there is none.
        first_line: Line of the first sample; by default the one after the header.
        columns: Names of the columns, in place of those of the file.

    Attributes:
        header: Names of the columns; a column of lists is one for each entry, ``name[0]``.
        lines: Line of each row in the file.
        left_out: What the file holds, or lost, and the table does not have, a sentence each.
    """

    def __init__(
        self,
        path: Path,
        what: str,
        *,
        header_line: int = 1,
        first_line: int | None = None,
        columns: Sequence[str] = (),
    ):
        self.path = path
        self._numbers: dict[str, Array] = {}
        self.used: set[str] = set()
        self._arrays: Columns = {}
        self.left_out: list[str] = []
        self.lines: Sequence[int]
        if is_container(path):
            self._arrays = _spread_arrays(path, read_columns(path))
            self.left_out = left_out_of(path)
            self.header = list(self._arrays)
            self.lines = range(1, 1 + len(self._arrays[self.header[0]]))
            return
        self._form = (path, what, header_line, first_line, columns)
        file, part = _run_in(path) if "#" in str(path) else (path, "")
        if part:
            whole = Table(
                file, what, header_line=header_line, first_line=first_line, columns=columns
            )
            self._arrays, self.left_out = _run_beside(whole, part), whole.left_out
            self.header = list(self._arrays)
            self.lines = whole.lines[: len(self._arrays[self.header[0]])]
            return
        if read := _all_numbers_of(*self._form):
            self._read, self._numbers, self.lines = read, dict(read.columns), read.lines
            self.header = list(self._numbers)
        else:
            passed: list[str] = []
            self.lines, self._cells = _all_cells_of(*self._form, passed)
            if passed:
                more = f", and {len(passed) - 1} more" if passed[1:] else ""
                self.left_out = [f"{path.name}: lines that are no rows: {passed[0]}{more}"]
            self.header = list(self._cells)

    @cached_property
    def _cells(self) -> dict[str, list[str]]:
        """Cells of each column, without blanks around them, where these were not read at first."""
        if self._arrays:
            arrays = self._arrays.items()
            return {name: [str(cell).strip() for cell in a.tolist()] for name, a in arrays}
        return _all_cells_of(*self._form, [])[1]

    @cached_property
    def unit_cells(self) -> dict[str, str]:
        """What stands below the name of each column, in the line right above the numbers."""
        if self._arrays:
            return {}
        path, _, header_line, first_line, columns = self._form
        if columns or not header_line or (first_line or 0) < header_line + 2:
            return {}
        with open_text(path) as file:
            lines = [file.readline(MAX_LINE + 1) for _ in range((first_line or 0) - 1)]
        mark = delimiter_of(lines[header_line - 1])
        names, cells = (cells_of(line, mark) for line in (lines[header_line - 1], lines[-1]))
        return dict(zip(names, cells, strict=False))

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
        return self._cells[name]

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
                values = np.array([float("" if "_" in c else c) if c else math.nan for c in cells])
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
        return self.numbers(name) if self.is_number[name] else text_of(self.texts(name))

    def columns(self) -> Columns:
        """All columns by name, each (num_rows,): numbers, or text."""
        return {name: self.values(name) for name in self.header}

    @cached_property
    def is_number(self) -> dict[str, bool]:
        """Whether a column holds numbers, by name; one without any cell does not."""
        found = dict[str, bool]()
        for name in self.header:
            if self._is_array(name) or name in self._numbers:
                values = self._arrays[name] if self._is_array(name) else self._numbers[name]
                found[name] = values.dtype.kind != "f" or not np.isnan(values).all()
                continue
            filled = [c for c in self._cells[name] if c and c.lower() not in MISSING]
            try:
                numbers = [float("" if "_" in c else c) for c in filled]
            except ValueError:
                numbers = []
            found[name] = bool(numbers) and all(map(math.isfinite, numbers))
        return found

    def _is_array(self, name: str) -> bool:
        return name in self._arrays and self._arrays[name].dtype.kind in "biuf"

    def seconds(
        self,
        column: str | None,
        factor: float | None,
        step: float | None,
        zero: float | str | None = None,
    ) -> Array:
        """Clock of the rows [s]; NaN where a stamp is missing.

        Args:
            column: Column with the time; None: ``time_s``.
            factor: Seconds in its unit; None: it holds times of day or dates.
            step: Seconds between rows, or for each count of the column.
            zero: Reading of the column that is 0 s, or "start", its first; None: 0.

        Raises:
            ValueError: no such column, or a cell that is no time.
        """
        if step is not None and column is None:
            return step * np.arange(len(self), dtype=np.float64)
        name = column or self.header[time_column(self.path, self.header)]
        if factor is None:
            dates = self.dates(name)
            return dates - dates[0]
        now = self.numbers(name)
        if zero is not None:
            now = now - (now[0] if isinstance(zero, str) else zero)
        scale = step or factor
        return scale * now if scale != 1.0 else now

    def dates(self, column: str) -> Array:
        """Times of day since midnight, or dates since 1970, as a column writes them [s].

        Raises:
            ValueError: no such column, or a cell that is no time.
        """
        try:
            return np.array(seconds_of_stamps(self.texts(column)))
        except ValueError as error:
            why, k = error.args
            where = f"{self.path}, row {self.lines[k]}, column {column}"
            raise ValueError(f"{where}: {why}") from None


def _run_in(path: Path) -> tuple[Path, str]:
    """File and label of a run in it; "" where the path is a file itself, or leads to none."""
    text = str(path)
    marks = [] if path.is_file() else [k for k, letter in enumerate(text) if letter == "#"]
    found = ((Path(text[:k]), text[k + 1 :]) for k in marks)
    return next((pair for pair in found if pair[0].is_file()), (path, ""))


def _run_beside(whole: Table, label: str) -> Columns:
    """Columns of one of the runs that stand side by side, to the last row that it has.

    Raises:
        ValueError: the table has no such run.
    """
    runs = runs_beside(whole.header)
    if label not in runs:
        there = f"it holds {', '.join(runs)}" if runs else "it holds no runs side by side"
        raise ValueError(f"{whole.path}: no run {label!r}; {there}")
    found = {name: whole.values(own) for name, own in runs[label].items()}
    has_cells = [a == a if a.dtype.kind == "f" else a != "" for a in found.values()]
    filled = np.flatnonzero(np.any(has_cells, axis=0))
    end = int(filled[-1]) + 1 if len(filled) else 0
    return {name: a[:end] for name, a in found.items()}


def as_label(cell: str) -> float | int | str:
    """A cell as the number that it holds, a whole one where it is whole, or as text."""
    try:
        value = float("" if "_" in cell else cell)
    except ValueError:
        return cell
    return int(value) if math.isfinite(value) and value == int(value) else value


@dataclass(frozen=True, eq=False)
class _Numbers:
    """A file of finite numbers: its columns by name, and the line of each row."""

    columns: dict[str, Array]
    lines: Sequence[int]


#: Files in memory, as long as a table has them: what ``init`` looked at need not be read again
_IN_MEMORY: WeakValueDictionary[tuple[object, ...], _Numbers] = WeakValueDictionary()


def _all_numbers_of(
    path: Path, what: str, header_line: int, first_line: int | None, columns: Sequence[str]
) -> _Numbers | None:
    """A file of finite numbers and empty cells; None: it has other cells.

    Reads eight times as fast as cell by cell, and holds little more than the numbers: they are put
    into place block by block.
    """
    with _open_lines(path, what, header_line, first_line, columns) as (header, mark, before, lines):
        state = path.stat()
        key = (path.resolve(), state.st_size, state.st_mtime_ns, mark, before, *header)
        if key in _IN_MEMORY or len(set(header)) < len(header):
            return _IN_MEMORY.get(key)
        waiting, num_rows, places = iter(lines), 0, list[Sequence[int]]()
        by, no_cells = None if mark == " " else mark, f"{mark} \r\n"
        found = np.empty((len(header), 0))
        for block in iter(lambda: list(islice(waiting, ROWS_SHOWN)), []):
            have_cells = [bool(line.strip() and line.strip(no_cells)) for line in block]
            filled = [*compress(block, have_cells)]
            try:
                now = np.loadtxt(filled, delimiter=by, comments=None, ndmin=2) if filled else None
            except ValueError:  # beside gaps; else it is told cell by cell which
                now = _numbers_beside_gaps(filled, mark)
                if now is None:
                    return None
            own: Sequence[int] = range(before + 1, before + 1 + len(block))
            before += len(block)
            if now is None:
                continue
            if now.shape != (len(filled), len(header)) or np.isinf(now).any():
                return None
            if num_rows + len(now) > found.shape[1]:  # about as many as these rows are long
                size = int(1.05 * state.st_size * len(filled) / sum(map(len, filled)))
                size = max(size, num_rows + len(now))
                # what is never filled in is never touched: it takes no memory
                found, before_it = np.empty((len(header), size)), found
                found[:, :num_rows] = before_it[:, :num_rows]
            found[:, num_rows : num_rows + len(now)] = now.T
            num_rows += len(now)
            if len(filled) < len(block):
                own = [*compress(own, have_cells)]
            places.append(own)
            if len(block) == ROWS_SHOWN:
                say_stage(f"reading {path.name}, row {num_rows}")
    if not num_rows:
        return None
    is_plain = places[-1][-1] - places[0][0] == num_rows - 1
    rows = range(places[0][0], places[0][0] + num_rows) if is_plain else list(chain(*places))
    _IN_MEMORY[key] = read = _Numbers(dict(zip(header, found[:, :num_rows], strict=True)), rows)
    return read


def _numbers_beside_gaps(lines: list[str], mark: str) -> Array | None:
    """Numbers of lines with empty cells, or decimal commas, (num_lines, num_cells); NaN where a
    cell is empty. None: a cell is no number, or lines differ in length."""
    text = "".join(lines)
    if mark == " " or (mark != "," and _LONE_COMMA.search(text)):
        return None
    text = re.sub(" {2,}", " ", text if mark == "," else text.replace(",", "."))
    full = _MISSING_CELL[mark].sub("nan", text).rstrip("\n")
    try:
        return np.loadtxt(full.split("\n"), delimiter=mark, comments=None, ndmin=2)
    except ValueError:
        return None


def _all_cells_of(
    path: Path,
    what: str,
    header_line: int,
    first_line: int | None,
    columns: Sequence[str],
    passed: list[str],
) -> tuple[list[int], dict[str, list[str]]]:
    """Line of each row of a file, and the cells by column, lists spread out."""
    with _open_lines(path, what, header_line, first_line, columns) as (header, mark, before, lines):
        rows = csv.reader(lines, delimiter=mark, skipinitialspace=mark == " ")
        numbered = list(_number_rows(path, header, rows, before, mark != ",", passed))
    if not numbered:
        raise ValueError(f"{path}: no rows below the header; was the export cut short?")
    places = [line for line, _ in numbered]
    by_column = zip(*(row for _, row in numbered), strict=True)
    cells = {n: [c.strip() for c in own] for n, own in zip(header, by_column, strict=True)}
    return places, _spread(path, places, cells)


def is_list(cell: str) -> bool:
    """Whether a cell holds a list of numbers, such as "[0.1, 0.2]" or "(1 2)"."""
    return cell[:1] in ("[", "(") and all(map(is_number, _entries(cell)))


def names_of(name: str, cell: str) -> list[str]:
    """Columns that a column makes by one of its cells: its entries where that is a list."""
    width = len(_entries(cell)) if is_list(cell) else 0
    return [f"{name}[{k}]" for k in range(width)] if 0 < width <= MOST_ENTRIES else [name]


def _entries(cell: str) -> list[str]:
    return _LIST_MARKS.sub(" ", cell).split()


def _spread(path: Path, lines: Sequence[int], cells: dict[str, list[str]]) -> dict[str, list[str]]:
    """A column whose cells are lists as a column for each entry: name[0], name[1], ..."""
    out: dict[str, list[str]] = {}
    for name, own in cells.items():
        first = next((cell for cell in own if cell), "")
        if (names := names_of(name, first)) == [name]:
            out[name] = own
            continue
        width = len(names)
        rows = [_entries(cell) or [""] * width for cell in own]
        if other := next((k for k, row in enumerate(rows) if len(row) != width), None):
            raise ValueError(
                f"{path}, row {lines[other]}, column {name}: a list of {len(rows[other])} numbers, "
                f"but the first has {width}"
            )
        out |= {entry: [row[k] for row in rows] for k, entry in enumerate(names)}
    return out


def _spread_arrays(path: Path, columns: Columns) -> Columns:
    """Columns of text that are lists, as in CSV files, as columns of numbers."""
    texts = {name: [str(c) for c in a] for name, a in columns.items() if a.dtype.kind not in "biuf"}
    lists = {name for name, cells in texts.items() if is_list(next(filter(None, cells), ""))}
    if not lists:
        return columns
    lines = range(1, 1 + len(next(iter(columns.values()))))
    out: Columns = {}
    for name, values in columns.items():
        entries = _spread(path, lines, {name: texts[name]}) if name in lists else {}
        out |= {n: np.array([float(c or "nan") for c in own]) for n, own in entries.items()}
        out |= {} if entries else {name: values}
    return out


def is_number(text: str) -> bool:
    """Whether a cell is a number, NaN and infinite ones too."""
    try:
        float("" if "_" in text else text)
    except ValueError:
        return False
    return True
