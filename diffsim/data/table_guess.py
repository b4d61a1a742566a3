"""What an unknown CSV file seems to hold: where its header is, which units its columns have."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path

from diffsim.core.units import to_si
from diffsim.data.table import (
    MISSING,
    NO_ROW,
    cells_of,
    delimiter_of,
    is_list,
    names_of,
    open_text,
)

FIRST_LINES = 60  # in which the header must be
FEWEST_ROWS = 5  # of numbers, that a file without a header must have
TABLES = (".csv", ".tsv", ".txt", ".dat", ".log", ".asc", ".lvm")
PLACE = "column_{}"  # name of a column without any
_NUMBER = re.compile(r"\s*[-+]?(\d+[.,]?\d*|[.,]\d+)([eE][-+]?\d+)?\s*")
_DATE = re.compile(r"\s*\d{4}-?\d\d-?\d\d[T_ ]\d\d.*")  # a clock, as numbers are
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
    "kg_s": "kg/s", "l_s": "l/s", "lpm": "l/min", "LPM": "l/min", "kW": "kW", "Ah": "A h",
    "mAh": "mA h", "ohm": "ohm", "Ohm": "ohm", "kOhm": "kohm", "mOhm": "mohm",
    "mV_V": "mV/V", "km_h": "km/h", "uL_min": "uL/min", "mL_min": "mL/min", "L_min": "L/min",
}  # fmt: skip
_LISTED = sorted(_ENDINGS, key=len, reverse=True)
_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER ([A-Z ]+)")
_DOTS = {"\N{COMBINING DOT ABOVE}": "dot ", "\N{COMBINING DIAERESIS}": "ddot "}
_WORDS = ("min", "s", "m")  # beside a unit: least, a letter
_ENDINGS_AFTER = {
    "A": ("A", r"cur|amp|(^|_)i_?\d*$"),
    "C": ("degC", r"temp"),
    "K": ("K", r"temp"),
    "g": ("g", r"mass|load|weight"),
}
#: What turns: its 1/min counts turns, as data sheets of German motors have it
_TURNS = re.compile(
    r"drehzahl|rotat|spindle|shaft|omega|^vitesse|^n_?\d*$|rpm"
    r"|^((motor|wheel|rotor|fan|pump|engine)[_ ]?)?speed",
    re.IGNORECASE,
)
#: Name of a clock.
TIME = re.compile(
    r"^(t|time|timestamp|stamp|zeit|zeitstempel|temps|tiempo|время|seconds|elapsed|clock)(_|$)",
    re.I,
)
_REMARK = "#% \t"  # what a line of remarks begins with
#: A name of a remark, with its unit: t F, t [s] F [N]
_SAID = re.compile(r"[^\s,;\[(]+(?:\s*[\[(][^\])]*[\])])?")
_PER_MINUTE = ("1/min", "1/Min", "min^-1", "min-1", "min⁻¹")


@dataclass(frozen=True)
class Column:
    """A column by its header."""

    name: str  # header as it stands in the file
    base: str  # name without its unit, fit for formulas
    unit: str | None  # unit that the header states; None: none
    # whether the unit stands apart, in brackets or a row of units; else it is the ending of the
    # name
    is_said: bool
    is_asked: bool = False  # whether it is of a table that holds what was commanded


@dataclass(frozen=True)
class TableLayout:
    """Where the header of a file is."""

    header_line: int  # line of the names, from 1; 0: there is none, or names take several lines
    first_line: int  # line of the first sample
    columns: tuple[Column, ...]  # columns in order
    has_names: bool = True  # whether the file names them


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
    last = next((row for row in reversed(rows) if _is_numeric(row)), [])
    # LabVIEW names a column of comments, and writes a cell where there is one
    bare = [i for i, row in enumerate(rows) if path.suffix == ".lvm" and row[-1:] == ["Comment"]]
    width = len(rows[bare[-1]]) - 1 if bare else None
    rows = [row[:width] for row in rows]
    last = last[:width]
    are_remarks = [line.lstrip()[:1] in NO_ROW for line in lines]
    like = (i for i, row in enumerate(rows) if len(row) > 1 and _is_like(row, last))
    first = next((i for i in like if not _is_above_names(rows, i)), None)
    above = [] if first is None else _lines_above(rows, first, are_remarks)
    if first is None or not above:
        return _without_header(rows)
    if len(above) == 1 and _are_channels_of(rows, above[0]):  # oscilloscopes number their channels
        above = [above[0] - 1, *above]
    names = _drop_empty_end(rows[above[0]])
    is_pair = len(above) == 2 and _are_units(rows[above[1]])
    is_part = bool(_names_twice(names)) or ("" in names and not is_pair)
    # a first column without a name that is no number of the row is a clock, most likely
    is_bare = not names[0] and not all(row[0].isdecimal() for row in rows[first:] if any(row))
    if is_bare or (len(above) > 1 and is_part):  # as of motion capture: bodies above their axes
        return _lines_as_names([rows[i] for i in above], above[-1] + 1, first + 1)
    units = [*(rows[above[1]] if len(above) > 1 else []), *[""] * len(names)]
    units[0] = units[0].lstrip(_REMARK)  # both lines may be remarks, as numpy writes them
    cells = [*rows[first], *[""] * len(names)]  # lists, "[0.1, 0.2]", are a column for each entry
    columns = (
        column_of(name, unit)
        for header, unit, cell in zip(names, units, cells, strict=False)
        for name in names_of(header, cell)
    )
    return TableLayout(0 if above[0] in bare else above[0] + 1, first + 1, tuple(columns))


def last_line(path: Path) -> str:
    """The last of a file's first lines that has a digit, at most 60 letters of it."""
    if not path.is_file():
        return ""
    with open_text(path) as file:
        lines = [line.strip() for line in islice(file, FIRST_LINES)]
    return next((line[:60] for line in reversed(lines) if re.search(r"\d", line)), "")


def _is_above_names(rows: list[list[str]], at: int) -> bool:
    """Whether a row of numbers is none of samples: those of bodies stand above their axes."""
    width = len(rows[at])
    near = [_are_names(row, width) for row in rows[max(at - 2, 0) : at + 3]]
    return any(near[-2:]) and not any(near[:-3])


def _are_names(row: list[str], width: int) -> bool:
    """Whether a row has a word in every cell, and no number."""
    words = (cell and cell.lower() not in MISSING and not _holds_numbers(cell) for cell in row)
    return len(row) == width and all(words)


def _lines_above(rows: list[list[str]], first: int, are_remarks: list[bool]) -> list[int]:
    """Indices of the lines right above the first numbers that may be names and units; lines that
    are blank, or remarks of the logger, may lie between."""
    # an empty last cell is a missing value, or what follows a delimiter at the end of the line
    num_cells = {len(rows[first]), len(_drop_empty_end(rows[first]))}
    above: list[int] = []
    for i in range(first - 1, -1, -1):
        head = _drop_empty_end(rows[i])
        is_other = not num_cells & {len(head), len(rows[i])}
        is_other |= any(_NUMBER.fullmatch(cell) for cell in head)
        is_other |= head[:1] == ["***End_of_Header***"]  # of LabVIEW
        if is_other and not above and are_remarks[i]:
            continue
        if is_other:
            break
        num_cells = {len(head), len(rows[i])}
        above.insert(0, i)
    return above


def _lines_as_names(above: list[list[str]], last: int, first: int) -> TableLayout:
    """A header of several lines: its lowest names, with those above where they occur twice.

    Args:
        last: Line of the lowest, from 1.
        first: Line of the first sample.
    """
    width = max(map(len, above))
    above = [[*row, *[""] * (width - len(row))] for row in above]
    units = [""] * width
    if len(above) > 1 and _are_units(above[-1]):
        *above, units = above
        last -= 1
    *parts, names = above
    for row in reversed(parts):  # what has no axis is named further up
        names = [name or cell for name, cell in zip(names, row, strict=True)]
    twice = _names_twice(names)
    if not twice and names == above[-1] and names[0]:
        columns = (column_of(name, unit) for name, unit in zip(names, units, strict=True))
        return TableLayout(last, first, tuple(columns))
    at = [k for k, name in enumerate(names) if name in twice]
    parts = [list(row) for row in parts]
    for row in parts:  # a cell that spans columns is written in the first of them
        for k in at:
            row[k] = row[k] or (row[k - 1] if k - 1 in at else "")
    telling = [row for row in parts if len({row[k] for k in at}) > 1]
    for k in at:
        names[k] = " ".join([*(row[k] for row in telling if row[k]), names[k]])
    named = (name or PLACE.format(k) for k, name in enumerate(names, 1))
    columns = (column_of(name, unit) for name, unit in zip(named, units, strict=True))
    return TableLayout(0, first, tuple(columns))


def _are_channels_of(rows: list[list[str]], units: int) -> bool:
    """Whether a line of units stands below one of numbered channels: x-axis, 1, 2."""
    names = rows[units - 1] if units else []
    numbers = [int(name) if name.isdecimal() else 0 for name in names[1:]]
    are_numbered = bool(numbers) and numbers[0] > 0 and sorted({*numbers}) == numbers
    return are_numbered and _are_units(rows[units]) and len(names) == len(rows[units])


def _are_units(row: list[str]) -> bool:
    filled = [cell for cell in row if cell]
    return bool(filled) and all(_is_unit(_bare_unit(cell)) for cell in filled)


def _bare_unit(cell: str) -> str:
    return cell.strip().strip("()[]{}<>").strip()


def _names_twice(names: list[str]) -> set[str]:
    return {name for name, count in Counter(names).items() if name and count > 1}


def _without_header(rows: list[list[str]]) -> TableLayout | None:
    """Numbers from some line on to the last, one a line at least."""
    rows = rows if rows and any(rows[-1]) else rows[:-1]
    width = len(rows[-1]) if rows else 0
    above = [i for i, row in enumerate(rows) if len(row) != width or not _is_numeric(row)]
    first = above[-1] + 1 if above else 0
    if len(rows) - first < FEWEST_ROWS:
        return None
    if said := _names_in_remarks(rows[:first], width):
        return TableLayout(0, first + 1, tuple(said))
    names = [PLACE.format(k) for k in range(1, 1 + width)]
    columns = [Column(name, name, None, False) for name in names]
    head = _drop_empty_end(rows[first - 1]) if first else []
    if 1 < len(head) < width and _are_names(head, len(head)) and not _names_twice(head):
        # R leaves out the name of its numbers of rows, which come first; others name no last one
        at = width - len(head) if _count_rows([row[0] for row in rows[first:]]) else 0
        columns[at : at + len(head)] = [column_of(name) for name in head]
    return TableLayout(0, first + 1, tuple(columns), has_names=False)


def _names_in_remarks(above: list[list[str]], width: int) -> list[Column]:
    """Columns as the remarks right above the numbers name them, divided otherwise than these: numpy
    writes ``# t F x`` above tabs; below them units may stand."""
    lines = [" ".join(row) for row in above]
    remarks = list(takewhile(lambda line: line[:1] in ("#", "%"), reversed(lines)))[:2]
    said = [_SAID.findall(line.lstrip(_REMARK)) for line in remarks]
    said = [cells if len(cells) == width and _are_names(cells, width) else [] for cells in said]
    if len(said) == 2 and all(said) and _are_units(said[0]):
        found = [[column_of(*pair) for pair in zip(said[1], said[0], strict=True)]]
    else:
        found = [[column_of(name) for name in cells] for cells in said if not _names_twice(cells)]
    # a sentence of as many words names no clock
    return next((one for one in found if any(TIME.match(c.base) for c in one)), [])


def _count_rows(cells: list[str]) -> bool:
    """Whether cells are 1, 2, 3 and on."""
    return cells == [str(k) for k in range(1, 1 + len(cells))]


def column_of(name: str, unit_cell: str = "") -> Column:
    """A column by its header and, if there is one, the cell of the row of units below it."""
    name = name.strip()
    if entry := _ENTRY.match(name):  # of a wide array: an index is no unit
        whole = column_of(entry.group(1), unit_cell)
        places = "_".join(re.findall(r"\d+", entry.group(2)))
        return Column(name, f"{whole.base}_{places}", whole.unit, whole.is_said)
    in_cell = _bare_unit(unit_cell)
    if in_cell and _is_unit(in_cell):
        unit = "rpm" if in_cell in _PER_MINUTE and _TURNS.search(name) else in_cell
        return Column(name, _word(name), unit, True)
    for pattern in (_BRACKETS, _AFTER, _SLASH, _LAST):
        if not (match := pattern.match(name)):
            continue
        given = match.group(2) or "-"
        if re.search(r"-\d", given) and (pattern is _LAST or given not in given.lower()):
            continue  # "Sensor s-1" is a label
        for unit in (given, given.lower()):  # RATE (DEG/S), too
            if _is_unit(unit):
                base = match.group(1)
                unit = "rpm" if unit in _PER_MINUTE and _TURNS.search(base) else unit
                return Column(name, _word(base), unit, True)
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
    filled = [cell for cell in row if cell and cell.lower() not in MISSING]
    return bool(filled) and 2 * sum(_holds_numbers(c) for c in filled) >= len(filled)


def _is_like(row: list[str], sample: list[str]) -> bool:
    """Whether a row is of numbers as a sample is; "rate, 100" above the header is not."""
    is_near = abs(len(row) - len(sample)) <= 1  # an empty last cell may be left out
    begins = not sample or not _holds_numbers(sample[0]) or not row[0] or _holds_numbers(row[0])
    return is_near and begins and _is_numeric(row)


def _holds_numbers(cell: str) -> bool:
    return bool(_NUMBER.fullmatch(cell) or _DATE.fullmatch(cell)) or is_list(cell)


def _is_unit(text: str) -> bool:
    try:
        to_si(text)
    except ValueError:
        return False
    return True


def _word(text: str) -> str:
    """A name that formulas can use; letters of any script are kept, Greek ones are spelled out."""
    plain = unicodedata.normalize("NFKC", "".join(map(_spell, unicodedata.normalize("NFC", text))))
    word = re.sub(r"\W+_*", "_", plain).strip("_") or "column"
    return word if word.isidentifier() else f"c_{word}"


def _spell(letter: str) -> str:
    """A Greek letter by its name, such as theta; a dot above is a derivative, any other itself."""
    if letter in _DOTS:
        return _DOTS[letter]
    name = unicodedata.name(letter, "")
    found = _GREEK.fullmatch(name)
    if found is None or "WITH" in name:
        return letter
    spelled = found[2].lower().replace("lamda", "lambda").removeprefix("final ")
    return f"{spelled if found[1] == 'SMALL' else spelled.capitalize()} "
