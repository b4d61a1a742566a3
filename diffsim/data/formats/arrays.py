"""NumPy's archives and Excel's sheets: arrays of one length are a table."""

from __future__ import annotations

import re
import zipfile
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.core.units import to_si
from diffsim.data.formats.columns import Columns, arrays_of_a_table, flat, require_room, text_of

_MOST_ROWS = 1_048_576  # of a sheet, by Excel
_HEADER_ROWS = 60  # in which the names of a sheet's columns must be
_MOST_TAGS = 2_000_000  # of a workbook, about 450,000 cells: read in some seconds
_TAGS_PER_BYTE = 6  # of its packed bytes; a table of zeros has 2, one of measured numbers 0.3
_EPOCH = datetime(1970, 1, 1)


def npz_parts(path: Path) -> list[str]:
    """One table."""
    return [""] if _npz(path)[0] else []


def read_npz(path: Path, part: str) -> Columns:
    """Columns of the arrays that have a row per sample."""
    arrays, _ = _npz(path)
    return dict(pair for name, values in arrays.items() for pair in flat(name, values))


def npz_left_out(path: Path, part: str) -> list[str]:
    """Arrays that are none of the table."""
    return _npz(path)[1]


def _npz(path: Path) -> tuple[Columns, list[str]]:
    """Numbers and text only: objects would run code."""
    found: Columns = {}
    others = []
    _require_room(path)
    with np.load(path, allow_pickle=False) as archive:
        for name in archive.files:
            try:
                found[name] = archive[name]
            except ValueError:
                others.append(
                    f"array {name}: objects, which are not read since they could run code"
                )
    readable = {name: v.shape for name, v in found.items() if v.dtype.kind in "biufU"}
    others += [f"array {name}: neither numbers nor text" for name in found if name not in readable]
    used, left = arrays_of_a_table(readable)
    return {name: found[name] for name in used}, [*left, *others]


def _require_room(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        require_room(path, sum(member.file_size for member in archive.infolist()))


def _require_few_tags(path: Path) -> None:
    """Refuse a workbook of more cells than its size lets one wait for."""
    most, count = max(_MOST_TAGS, _TAGS_PER_BYTE * path.stat().st_size), 0
    with zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            with archive.open(name) as member:
                while count <= most and (block := member.read(1 << 20)):
                    count += block.count(b"<")
    if count > most:
        raise ValueError(
            f"its sheets have more than {most:,} tags, at most {most // 4:,} cells are read of a "
            "workbook of its size; save the table as CSV"
        )


def xlsx_parts(path: Path) -> list[str]:
    """Sheets with a line of names above numbers."""
    book = _open(path)
    try:
        return [sheet.title for sheet in book.worksheets if _header(sheet) is not None]
    finally:
        book.close()


def xlsx_left_out(path: Path, part: str) -> list[str]:
    """Sheets without a table."""
    tables, book = xlsx_parts(path), _open(path)
    try:
        return [f"sheet {name}: no table" for name in book.sheetnames if name not in tables]
    finally:
        book.close()


def read_xlsx(path: Path, part: str) -> Columns:
    """Columns of a sheet; empty cells are NaN, dates are seconds since 1970."""
    book = _open(path)
    try:
        sheet = book[part]
        found = _header(sheet)
        assert found is not None  # of xlsx_parts
        line, names = found
        cells = sheet.iter_rows(
            min_row=line + 1, max_row=_MOST_ROWS, max_col=max(names) + 1, values_only=True
        )
        rows = [row for row in cells if any(cell is not None for cell in row)]
    finally:
        book.close()
    return {name: _column([row[k] for row in rows]) for k, name in names.items()}


def _header(sheet: Any) -> tuple[int, dict[int, str]] | None:
    """Line above the numbers, from 1, and the names by place: texts right above the first numbers,
    with the units that a row between them states."""
    above: dict[int, str] = {}
    names: dict[int, str] = {}
    first = 0  # line of numbers below the names: one of a single cell may come before
    for line, row in enumerate(sheet.iter_rows(max_row=_HEADER_ROWS, values_only=True), start=1):
        numbers = [k for k, cell in enumerate(row) if _is_number(cell)]
        texts = {k: cell.strip() for k, cell in enumerate(row) if isinstance(cell, str)}
        first = first or line * bool(numbers)
        if len(numbers) >= 2:
            if set(numbers) <= set(above) and all(map(_is_bare_unit, names.values())):
                names = {k: f"{name} {_in_brackets(names.get(k, ''))}" for k, name in above.items()}
                names = {k: name.strip() for k, name in names.items()}
            if set(numbers) <= set(names):
                if len(set(names.values())) < len(names):
                    raise ValueError(
                        f"sheet {sheet.title!r}, row {first - 1}: two columns have the same name"
                    )
                return first - 1, names
        if any(texts.values()) or len(numbers) >= 2:
            above, names, first = names, {k: text for k, text in texts.items() if text}, 0
    return None


def _is_bare_unit(text: str) -> bool:
    try:
        to_si(text.strip("()[]{}<> "))
    except ValueError:
        return False
    return True


def _in_brackets(unit: str) -> str:
    bare = unit.strip("()[]{}<> ")
    return f"[{bare}]" if bare else ""


def _is_number(cell: Any) -> bool:
    return isinstance(cell, (int, float, datetime, time, timedelta)) and not isinstance(cell, bool)


def _column(cells: list[Any]) -> NDArray[Any]:
    if any(isinstance(cell, str) and not _MISSING.fullmatch(cell) for cell in cells):
        return text_of(["" if cell is None else str(cell) for cell in cells])
    return np.array([_seconds_or_number(cell) for cell in cells], dtype=np.float64)


_MISSING = re.compile(r"\s*(#N/A|NaN|n/?a|-*)\s*", re.I)


def _seconds_or_number(cell: Any) -> float:
    if isinstance(cell, datetime):
        return (cell.replace(tzinfo=None) - _EPOCH).total_seconds()
    if isinstance(cell, time):
        return cell.hour * 3600.0 + cell.minute * 60.0 + cell.second + 1e-6 * cell.microsecond
    if isinstance(cell, timedelta):
        return cell.total_seconds()
    return np.nan if cell is None or isinstance(cell, str) else float(cell)


def _open(path: Path) -> Any:
    openpyxl = optional("openpyxl", purpose="an Excel file")
    _require_room(path)
    _require_few_tags(path)
    book = openpyxl.load_workbook(path, read_only=True, data_only=True, keep_links=False)
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # one cell in the last corner would fill all rows with gaps
    return book
