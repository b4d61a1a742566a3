"""Tables as messages of a log, one per row: the clock, and columns as typed, nested fields."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CLOCKS = ("time_s", "t", "time")
"""Columns that may be the clock of the messages, the first that is there."""

_PATH = re.compile(r"([^.\[\]]+(?:\.[^.\[\]]+)*)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class Field:
    """A number, a text, or a list of them in every message.

    Attributes:
        name: As the format spells it.
        columns: Columns of the table that it holds, one per entry.
        is_list: Whether it is a list, even of one entry.
    """

    name: str
    columns: tuple[str, ...]
    is_list: bool


@dataclass(frozen=True)
class Record:
    """Fields inside of a field, as ``pose`` has ``position``.

    Attributes:
        name: As the format spells it.
        fields: What it holds, in the order of the columns.
    """

    name: str
    fields: tuple[Field | Record, ...]


def stamps(columns: Mapping[str, NDArray[Any]], per_second: int, what: str) -> NDArray[np.int64]:
    """Ticks of the rows since the first.

    Args:
        columns: Columns by name, each (num_rows,); ``time_s``, ``t`` or ``time`` [s] is the clock.
        per_second: Ticks of the format's clock in a second.
        what: The format, as a message names it, such as "an MCAP file".

    Returns:
        Ticks, (num_rows,).

    Raises:
        ValueError: no column is the clock, it does not ascend, or two rows share a tick.
    """
    name = next((c for c in CLOCKS if c in columns), None)
    if name is None:
        raise ValueError(
            f"{what} needs a clock: a column {', '.join(CLOCKS[:-1])} or {CLOCKS[-1]} in "
            f"seconds, got {', '.join(columns)}"
        )
    time = np.asarray(columns[name], dtype=np.float64)
    if not np.isfinite(time).all() or (np.diff(time) < 0.0).any():
        raise ValueError(f"column {name}, the clock of {what}, must be finite and ascend")
    ticks = np.round((time - time[0]) * per_second).astype(np.int64)
    shared = (np.diff(ticks) == 0) & (np.diff(time) > 0.0)
    if shared.any():
        row = int(np.argmax(shared)) + 1
        raise ValueError(
            f"column {name}: rows {row} and {row + 1} are {time[row] - time[row - 1]:g} s apart, "
            f"but the clock of {what} counts steps of {1 / per_second:g} s"
        )
    return ticks


def fields_of(
    columns: Mapping[str, NDArray[Any]], spell: Callable[[str], str]
) -> tuple[Field | Record, ...]:
    """Columns as fields: ``pose.position.x`` is nested, ``q[0]``, ``q[1]`` are a list.

    Args:
        columns: Columns by name, each (num_rows,), without the clock.
        spell: A word as the format allows it.

    Returns:
        Fields, in the order of the columns.

    Raises:
        ValueError: two columns would have the same name.
    """
    lists = _lists(columns)
    tree: dict[str, Any] = {}
    for name in columns:
        base, index = lists.get(name, (None, 0))
        if index:
            continue  # the list's first entry stands for it
        dotted = _PATH.fullmatch(name if base is None else base)
        path = dotted[1].split(".") if dotted and dotted[2] is None else [name]
        held = (name,) if base is None else _entries(lists, base)
        _put(tree, [spell(word) for word in path], held, base is not None)
    return _tree(tree)


def names_of(fields: Sequence[Field | Record], inside: str = "") -> dict[str, str]:
    """Names under which columns are read back.

    Args:
        fields: As ``fields_of`` makes them.
        inside: What stands before each name, such as "pose.".

    Returns:
        Such as ``pose.position.x`` or ``q[0]`` by column, in the order of the message.
    """
    names: dict[str, str] = {}
    for field in fields:
        name = f"{inside}{field.name}"
        if isinstance(field, Record):
            names |= names_of(field.fields, f"{name}.")
        else:
            spelled = [f"{name}[{k}]" if field.is_list else name for k in range(len(field.columns))]
            names |= dict(zip(field.columns, spelled, strict=True))
    return names


def _lists(columns: Mapping[str, NDArray[Any]]) -> dict[str, tuple[str, int]]:
    """Columns that are entries of whole lists, 0 to n - 1 of one type: their list and entry."""
    found: dict[str, dict[int, str]] = {}
    for name in columns:
        match = _PATH.fullmatch(name)
        if match and match[2] is not None:
            found.setdefault(match[1], {})[int(match[2])] = name
    whole = {
        base: entries
        for base, entries in found.items()
        if sorted(entries) == list(range(len(entries)))
        and len({columns[name].dtype.str for name in entries.values()}) == 1
    }
    return {name: (base, k) for base, entries in whole.items() for k, name in entries.items()}


def _entries(lists: Mapping[str, tuple[str, int]], base: str) -> tuple[str, ...]:
    own = {k: name for name, (of, k) in lists.items() if of == base}
    return tuple(own[k] for k in range(len(own)))


def _put(tree: dict[str, Any], path: Sequence[str], held: tuple[str, ...], is_list: bool) -> None:
    for word in path[:-1]:
        tree = tree.setdefault(word, {})
        if not isinstance(tree, dict):
            raise ValueError(_same(tree.columns[0], held[0], word))
    if path[-1] in tree:
        other = tree[path[-1]]
        while isinstance(other, dict):
            other = next(iter(other.values()))
        raise ValueError(_same(other.columns[0], held[0], path[-1]))
    tree[path[-1]] = Field(path[-1], held, is_list)


def _same(one: str, other: str, word: str) -> str:
    return f"columns {one} and {other} would both be field {word}; rename one"


def _tree(tree: Mapping[str, Any]) -> tuple[Field | Record, ...]:
    return tuple(
        Record(word, _tree(inner)) if isinstance(inner, dict) else inner
        for word, inner in tree.items()
    )


__all__ = ["CLOCKS", "Field", "Record", "fields_of", "names_of", "stamps"]
