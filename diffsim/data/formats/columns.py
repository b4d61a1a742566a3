"""Nested records as columns: ``pose.position.x``, ``q[0]``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Columns by name, all of one length: float64, integers or text.
Columns = dict[str, NDArray[Any]]

MAX_COLUMNS = 10_000  # of a table
MOST_ENTRIES = 64  # of a list in a message: clouds and pictures are no columns


def require_few(count: int, what: str = "columns") -> None:
    """Refuse a table of more columns than ``MAX_COLUMNS``.

    Args:
        count: How many it has.
        what: What it calls them.
    """
    if count > MAX_COLUMNS:
        raise ValueError(f"at most {MAX_COLUMNS:,} {what}, got {count:,}")


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


def of_messages(messages: Sequence[Mapping[str, Any]]) -> Columns:
    """Columns of messages with the same fields; what only some have is empty in the others.

    Args:
        messages: Numbers, text, and mappings and short lists of them.
    """
    rows = [dict(_leaves("", message)) for message in messages]
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: _column([row.get(name) for row in rows]) for name in names}


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
        return np.array(["" if cell is None else str(cell) for cell in cells])
    if None not in cells and all(isinstance(cell, (int, np.integer)) for cell in cells):
        return np.array(cells)
    return np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
