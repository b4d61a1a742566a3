"""What an unknown CSV file seems to hold: where its header is, which units its columns have."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from diffsim.core.units import to_si
from diffsim.data.table import cells_of, delimiter_of, is_list, names_of, open_text

FIRST_LINES = 60  # in which the header must be
FEWEST_ROWS = 5  # of numbers, that a file without a header must have
TABLES = (".csv", ".tsv", ".txt", ".dat")
_NUMBER = re.compile(r"\s*[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?\s*")
_ENTRY = re.compile(r"^(.*[^\]])((?:\[\d+\])+)$")
_BRACKETS = re.compile(r"^(.*?)\s*[(\[{<]\s*([^)\]}>]*?)\s*[)\]}>]\s*$")
_AFTER = re.compile(r"^(.*\S)\s+(?:/|in)\s+(\S+)$")
_SLASH = re.compile(r"^([^\s/]+)/(\S+)$")  # t/min, F/N, as ISO 80000 has it
_LAST = re.compile(r"^(.*\S)\s+(%|\S{2,})$")  # Throttle %, gyro deg/s
#: Endings of names that are units; some only after a word that speaks of them.
_ENDINGS = {
    "rad_s2": "rad/s^2", "m_s2": "m/s^2", "mm_s2": "mm/s^2", "m3_s": "m^3/s", "m2_s": "m^2/s",
    "rad_s": "rad/s", "deg_s": "deg/s", "m_s": "m/s", "mm_s": "mm/s", "cm_s": "cm/s",
    "px_s": "px/s", "ml_s": "ml/s", "ml_min": "ml/min", "l_min": "l/min", "mNm": "mN m",
    "Nm": "N m", "mm": "mm", "cm": "cm", "um": "um", "km": "km", "m": "m", "ms": "ms", "us": "us",
    "s": "s", "min": "min", "mN": "mN", "kN": "kN", "N": "N", "MPa": "MPa", "kPa": "kPa",
    "hPa": "hPa", "Pa": "Pa", "mbar": "mbar", "bar": "bar", "psi": "psi", "mrad": "mrad",
    "rad": "rad", "deg": "deg", "rpm": "rpm", "dps": "deg/s", "pct": "%", "kHz": "kHz", "Hz": "Hz",
    "mV": "mV", "V": "V", "mA": "mA", "W": "W", "kg": "kg", "px": "px", "ml": "ml",
    "degC": "degC", "percent": "%", "mps2": "m/s^2", "mps": "m/s", "kmh": "km/h", "kph": "km/h",
    "degps": "deg/s",
    "mV_V": "mV/V", "km_h": "km/h", "uL_min": "uL/min", "mL_min": "mL/min", "L_min": "L/min",
}  # fmt: skip
_LISTED = sorted(_ENDINGS, key=len, reverse=True)
_WORDS = ("min", "s", "m")  # beside a unit: least, a letter
_ENDINGS_AFTER = {
    "A": ("A", r"cur|amp|(^|_)i_?\d*$"),
    "C": ("degC", r"temp"),
    "K": ("K", r"temp"),
    "g": ("g", r"mass|load|weight"),
}


@dataclass(frozen=True)
class Column:
    """A column by its header.

    Attributes:
        name: Header as it stands in the file.
        base: Name without its unit, fit for formulas.
        unit: Unit that the header states; None: none.
        is_said: Whether the unit stands apart, in brackets or a row of units; else it is the
            ending of the name.
        is_asked: Whether it is of a table that holds what was commanded.
    """

    name: str
    base: str
    unit: str | None
    is_said: bool
    is_asked: bool = False


@dataclass(frozen=True)
class TableLayout:
    """Where the header of a file is.

    Attributes:
        header_line: Line of the names, from 1; 0: there is none.
        first_line: Line of the first sample.
        columns: Columns in order.
    """

    header_line: int
    first_line: int
    columns: tuple[Column, ...]


def layout_of(path: Path) -> TableLayout | None:
    """Header of a file: the lines of as many cells, without numbers, above the first numbers.

    Returns:
        None where there are no rows of numbers below names, nor ``FEWEST_ROWS`` without any.
    """
    with open_text(path) as file:
        lines = [line.rstrip("\r\n") for line in islice(file, FIRST_LINES)]
    marks = [delimiter_of(line, line) for line in lines]
    if marks and marks[-1] == " ":  # names between blanks, too
        marks = [" "] * len(lines)
    rows = [cells_of(line, mark) for line, mark in zip(lines, marks, strict=True)]
    first = next((i for i, row in enumerate(rows) if len(row) > 1 and _is_numeric(row)), None)
    above = [] if first is None else _lines_above(rows, first)
    if first is None or not above:
        return _without_header(rows)
    names = _drop_empty_end(rows[above[0]])
    units = _drop_empty_end(rows[above[1]]) if len(above) > 1 else [""] * len(names)
    cells = [*rows[first], *[""] * len(names)]  # lists, "[0.1, 0.2]", are a column for each entry
    columns = (
        column_of(name, unit)
        for header, unit, cell in zip(names, units, cells, strict=False)
        for name in names_of(header, cell)
    )
    return TableLayout(above[0] + 1, first + 1, tuple(columns))


def _lines_above(rows: list[list[str]], first: int) -> list[int]:
    """Indices of the lines right above the first numbers that may be names and units."""
    # an empty last cell is a missing value, or what follows a delimiter at the end of the line
    num_cells = {len(rows[first]), len(_drop_empty_end(rows[first]))}
    above: list[int] = []
    for i in range(first - 1, -1, -1):
        head = _drop_empty_end(rows[i])
        if len(head) not in num_cells or any(_NUMBER.fullmatch(c) for c in head):
            break
        num_cells = {len(head)}
        above.insert(0, i)
    return above


def _without_header(rows: list[list[str]]) -> TableLayout | None:
    """Numbers from some line on to the last, one a line at least."""
    rows = rows if rows and any(rows[-1]) else rows[:-1]
    width = len(rows[-1]) if rows else 0
    above = [i for i, row in enumerate(rows) if len(row) != width or not _is_numeric(row)]
    first = above[-1] + 1 if above else 0
    if len(rows) - first < FEWEST_ROWS:
        return None
    names = (f"column_{k}" for k in range(1, 1 + width))
    return TableLayout(0, first + 1, tuple(Column(name, name, None, False) for name in names))


def column_of(name: str, unit_cell: str = "") -> Column:
    """A column by its header and, if there is one, the cell of the row of units below it."""
    name = name.strip()
    if entry := _ENTRY.match(name):  # of a wide array: an index is no unit
        whole = column_of(entry.group(1), unit_cell)
        places = "_".join(re.findall(r"\d+", entry.group(2)))
        return Column(name, f"{whole.base}_{places}", whole.unit, whole.is_said)
    in_cell = unit_cell.strip().strip("()[]{}<>").strip()
    if in_cell and _is_unit(in_cell):
        return Column(name, _word(name), in_cell, True)
    for pattern in (_BRACKETS, _AFTER, _SLASH, _LAST):
        match = pattern.match(name)
        if match and _is_unit(match.group(2) or "-"):
            return Column(name, _word(match.group(1)), match.group(2) or "-", True)
    for ending in _LISTED:
        if name.endswith(f"_{ending}"):
            base = name[: -len(ending) - 1]
            before = base.rpartition("_")[2]
            if "_" not in ending and before != base and _is_ending(before):
                break  # stiff_N_mm: neither mm nor surely N/mm
            return Column(name, _word(base), _ENDINGS[ending], False)
    for ending, (unit, after) in _ENDINGS_AFTER.items():
        base = name.removesuffix(f"_{ending}")
        if base != name and re.search(after, base, re.IGNORECASE):
            return Column(name, _word(base), unit, False)
    is_speed = re.fullmatch(r"rpm_?\d*", name, re.IGNORECASE)  # of the first motor: rpm1
    return Column(name, _word(name), "rpm" if is_speed else None, False)


def _is_ending(word: str) -> bool:
    return word in _ENDINGS and word not in _WORDS


def _drop_empty_end(row: list[str]) -> list[str]:
    return row[:-1] if row and not row[-1] else row


def _is_numeric(row: list[str]) -> bool:
    filled = [cell for cell in row if cell]
    return bool(filled) and 2 * sum(_holds_numbers(c) for c in filled) >= len(filled)


def _holds_numbers(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell)) or is_list(cell)


def _is_unit(text: str) -> bool:
    try:
        to_si(text)
    except ValueError:
        return False
    return True


def _word(text: str) -> str:
    """A name that formulas can use."""
    word = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_") or "column"
    return f"c_{word}" if word[0].isdigit() else word
