"""Nested records as columns: ``pose.position.x``, ``q[0]``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core import files
from diffsim.core.checked import checked

#: Columns by name, all of one length: float64, integers or text.
Columns = dict[str, NDArray[Any]]

MAX_COLUMNS = 10_000  # of a table
MOST_UNPACKED = 1_000_000_000  # bytes of the numbers of a file, however small it is
LETTER = 4  # bytes, in NumPy's text
_BLOCK = 10_000  # messages that become numbers at once
MOST_ENTRIES = 64  # of a list in a message: clouds and pictures are no columns


def require_few(count: int, what: str = "columns") -> None:
    """Refuse a table of more columns than ``MAX_COLUMNS``.

    Args:
        count: How many it has.
        what: What it calls them.
    """
    if count > MAX_COLUMNS:
        raise ValueError(f"at most {MAX_COLUMNS:,} {what}, got {count:,}")


def most_unpacked(path: Path) -> int:
    """Bytes that the numbers of a file may take."""
    return files.most_unpacked(path, MOST_UNPACKED)


def require_room(path: Path, unpacked: int) -> None:
    """Refuse a file that says of itself that it unpacks to more than ``most_unpacked``.

    Args:
        unpacked: Bytes that it says it has.
    """
    if unpacked > (most := most_unpacked(path)):
        raise ValueError(f"it unpacks to {unpacked:,} bytes, at most {most:,} are read")


def require_text(names: Iterable[str], *values: NDArray[Any]) -> list[str]:
    """Refuse halves of characters, which no file and no page can hold.

    Args:
        names: Of columns or parts.
        values: Columns; those of text are looked through.

    Returns:
        The names.
    """
    names = list(names)
    texts = [np.asarray(column) for column in (names, *values)]
    for text in (text for text in texts if text.dtype.kind == "U" and text.size):
        codes = np.ascontiguousarray(text)[..., None].view(np.uint32)
        is_half = ((codes >= 0xD800) & (codes <= 0xDFFF)).any(-1)
        if is_half.any():
            raise ValueError(f"half of a character in {str(text[is_half][0])!r}; write it anew")
    return names


def text_of(cells: Sequence[str]) -> NDArray[Any]:
    """Text of a column; refused where one long cell would make an array of gigabytes.

    Args:
        cells: In an array each takes the room of the longest.
    """
    require_text_room(max(map(len, cells), default=0), len(cells))
    return np.array(cells) if len(cells) else np.empty(0, "U1")


def require_text_room(longest: int, count: int) -> None:
    """Refuse an array of text of more than ``MOST_UNPACKED`` bytes.

    Args:
        longest: Letters of its longest cell.
    """
    if (needed := LETTER * longest * count) > MOST_UNPACKED:
        raise ValueError(
            f"a text of {longest:,} letters in a column of {count:,} rows: {needed:,} bytes, at "
            f"most {MOST_UNPACKED:,} are read"
        )


@checked
def flat(name: str, values: NDArray[Any]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of an array with a row per sample.

    Args:
        name: What the array is called.
        values: (num_rows,) or (num_rows, ...).

    Yields:
        One column per entry of a row: ``name``, or ``name[0]``, ``name[1]`` and so on.
    """
    if values.ndim == 1:
        yield name, values
    elif values.ndim == 2 and values.shape[1] == 1:
        yield name, values[:, 0]
    else:
        for k in range(values.shape[1]):
            yield from flat(f"{name}[{k}]", values[:, k])


def arrays_of_a_table(
    shapes: Mapping[str, tuple[int, ...]], what: str = "array"
) -> tuple[list[str], list[str]]:
    """Which arrays are one table: those of the length that most have.

    Single numbers beside the samples are settings, and pictures are no columns.

    Args:
        shapes: Shape of each array by name; the first axis is that of the samples.
        what: What the format calls an array.

    Returns:
        Names of the arrays that are used, and a sentence for each of the others.
    """
    out = []
    narrow = {}
    for name, shape in shapes.items():
        if not shape:
            out.append(f"{what} {name}: a single value")
        elif int(np.prod(shape[1:])) > MOST_ENTRIES:
            row = " x ".join(map(str, shape[1:]))
            out.append(f"{what} {name}: {row} numbers a row, at most {MOST_ENTRIES} are columns")
        else:
            narrow[name] = shape
    lengths = [shape[0] for shape in narrow.values()]
    most = max(lengths, key=lambda n: (lengths.count(n) if n > 1 else 0, n), default=0)
    for name, shape in narrow.items():
        if shape[0] != most:
            out.append(f"{what} {name}: another number of rows than most have")
    return [name for name, shape in narrow.items() if shape[0] == most], out


def of_messages(messages: Iterable[Mapping[str, Any]]) -> Columns:
    """Columns of messages with the same fields; what only some have is empty in the others.

    Messages become numbers a block at a time: as Python's objects they take twenty times the room.

    Args:
        messages: Numbers, text, and mappings and short lists of them.
    """
    blocks = [_block_of(block) for block in _cut(messages)]
    names = dict.fromkeys(name for _, columns in blocks for name in columns)
    require_few(len(names))
    return {name: _join([(n, columns.get(name)) for n, columns in blocks]) for name in names}


def _cut(messages: Iterable[Mapping[str, Any]]) -> Iterator[list[Mapping[str, Any]]]:
    waiting = iter(messages)
    while block := list(islice(waiting, _BLOCK)):
        yield block


def _block_of(messages: Sequence[Mapping[str, Any]]) -> tuple[int, Columns]:
    rows = [dict(_leaves("", message)) for message in messages]
    names = dict.fromkeys(name for row in rows for name in row)
    require_few(len(names))
    return len(rows), {name: _column([row.get(name) for row in rows]) for name in names}


def _join(parts: Sequence[tuple[int, NDArray[Any] | None]]) -> NDArray[Any]:
    """A column of its blocks; None where a block has nothing of it."""
    is_text = any(part is not None and part.dtype.kind == "U" for _, part in parts)
    if not is_text:
        return np.concatenate([np.full(n, np.nan) if p is None else p for n, p in parts])
    texts = [np.full(n, "") if p is None else _as_text(p) for n, p in parts]
    require_text_room(max(part.dtype.itemsize for part in texts) // LETTER, sum(map(len, texts)))
    return np.concatenate(texts)


def _as_text(values: NDArray[Any]) -> NDArray[Any]:
    gaps = np.isnan(values) if values.dtype.kind == "f" else np.zeros(len(values), bool)
    return values if values.dtype.kind == "U" else np.where(gaps, "", values.astype(str))


def fields_left_out(message: Mapping[str, Any], name: str = "") -> Iterator[str]:
    """Fields of a message that are no columns, a sentence each.

    Args:
        message: As ``of_messages`` has them.
        name: Where it stands in another one.
    """
    for key, value in message.items():
        field = f"{name}.{key}" if name else str(key)
        if isinstance(value, Mapping):
            yield from fields_left_out(value, field)
        elif isinstance(value, (list, tuple, np.ndarray, bytes)) and len(value) > MOST_ENTRIES:
            yield f"field {field}: {len(value)} entries, at most {MOST_ENTRIES} are columns"


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), inner)
    elif isinstance(value, (str, bool, int, float, np.generic)):
        yield name, value
    elif isinstance(value, (list, tuple, np.ndarray)) and 0 < len(value) <= MOST_ENTRIES:
        for k, inner in enumerate(value):
            yield from _leaves(f"{name}[{k}]", inner)


def _column(cells: list[Any]) -> NDArray[Any]:
    if any(isinstance(cell, str) for cell in cells):
        return text_of(["" if cell is None else str(cell) for cell in cells])
    if None not in cells and all(isinstance(cell, (int, np.integer)) for cell in cells):
        return np.array(cells)
    return np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
