"""JSON of loggers: lists of records, or of each column's values, and facts beside them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.data.formats.columns import (
    MOST_ENTRIES,
    Columns,
    arrays_of_a_table,
    fields_left_out,
    flat,
    of_messages,
    require_few,
    text_of,
)

_FIRST_MESSAGES = 2_000  # of a log, which tell whether it has topics
_FEWEST_OF_TOPIC = 3  # messages, on average
_FEWEST_ROWS = 20  # of lists by column: shorter ones have a number for each joint or rotor


@dataclass(frozen=True, eq=False)
class _Table:
    """A table of a file."""

    content: Sequence[Mapping[str, Any]] | Mapping[str, Any]  # its records, or its values by column
    facts: Mapping[str, Any]  # numbers and texts that stand beside it, by name

    def columns(self) -> Columns:
        """Its columns, and one constant column for every fact of another name."""
        if isinstance(self.content, Mapping):
            arrays, _ = _arrays_of(self.content)
            found = dict(pair for name, array in arrays.items() for pair in flat(name, array))
        else:
            found = of_messages(self.content)
        count = len(next(iter(found.values()), ()))
        for name, value in self.facts.items():
            found.setdefault(name, np.full(count, value))
        return {name: v.astype(np.int64) if v.dtype == bool else v for name, v in found.items()}

    def left_out(self) -> list[str]:
        """What is no column, a sentence each."""
        if isinstance(self.content, Mapping):
            return _arrays_of(self.content)[1]
        return list(fields_left_out(self.content[0]))


def parts(path: Path) -> list[str]:
    """Tables by the keys that lead to them, ``episode.steps`` where deeper; "" where the file is
    one. Those of a list of runs have their place in it, ``data.0``, ``data.1``."""
    found = list(_tables_of(path))
    require_few(len(found), "tables")
    return found


def read(path: Path, part: str) -> Columns:
    """Columns of a table, and one constant column for every fact that stands beside it.

    A fact is a number or text of an object that holds the table, or of an object in such a one,
    ``config.rate``; a column of its name goes first. The part "" of a log is all of its messages,
    as studies from before topics were told apart have it.
    """
    found = _tables_of(path)
    return found[part].columns() if part in found else _Table(_content(path), {}).columns()


def left_out(path: Path, part: str) -> list[str]:
    """Fields of the first record, or lists, that are no columns."""
    table = _tables_of(path).get(part)
    return [] if table is None else table.left_out()


def _tables_of(path: Path) -> dict[str, _Table]:
    state = path.stat()
    return _read_tables(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=1)  # its tables are asked for one by one, and reading takes them all
def _read_tables(path: Path, size: int, changed_ns: int) -> dict[str, _Table]:
    return dict(_tables(_content(path), "", {}))


def _content(path: Path) -> Any:
    """The whole file; of JSON lines, which have a record each, a list of them."""
    text = path.read_text("utf-8-sig")
    if path.suffix.lower() == ".jsonl":
        return [json.loads(line) for line in text.splitlines() if line.strip()]
    return json.loads(text)


def _tables(value: Any, name: str, facts: Mapping[str, Any]) -> Iterator[tuple[str, _Table]]:
    """Tables inside a value, each with the keys that lead to it."""
    if isinstance(value, list):
        if not value or not all(isinstance(entry, Mapping) for entry in value):
            return
        are_runs = _are_runs(value)
        if not are_runs and (key := _topic_key(value)):
            by: dict[str, list[Mapping[str, Any]]] = {}
            for message in value:
                rest = {k: own for k, own in message.items() if k != key}
                by.setdefault(str(message.get(key, "")), []).append(rest)
            yield from ((_below(name, topic), _Table(own, facts)) for topic, own in by.items())
            return
        if not are_runs:
            yield name, _Table(value, facts)
            return
        for k, run in enumerate(value):
            yield _below(name, str(k)), _Table(run, {**facts, **_facts_of(run)})
    elif isinstance(value, Mapping):
        facts = {**facts, **_facts_of(value)}
        if _is_table(value):
            yield name, _Table(value, facts)
            return
        for key, inner in value.items():
            yield from _tables(inner, _below(name, str(key)), facts)


def _topic_key(messages: Sequence[Mapping[str, Any]]) -> str:
    """Field whose text says which others a message has, as the topic of a log does; empty: none."""
    first = messages[:_FIRST_MESSAGES]
    fields = [frozenset(_leaf_names(message)) for message in first]
    if len(set(fields)) == 1:
        return ""
    for key, value in first[0].items():
        topics = [message.get(key) for message in first]
        if not isinstance(value, str) or not all(isinstance(topic, str) for topic in topics):
            continue
        pairs = set(zip(topics, fields, strict=True))
        if len({topic for topic, _ in pairs}) == len(pairs) < len(first) / _FEWEST_OF_TOPIC:
            return str(key)
    return ""


def _leaf_names(message: Mapping[str, Any], name: str = "") -> Iterator[str]:
    for key, value in message.items():
        field = _below(name, str(key))
        yield from _leaf_names(value, field) if isinstance(value, Mapping) else (field,)


def is_log(path: Path) -> bool:
    """Whether a file holds messages of several topics, a table each, recorded at the same time.

    Args:
        path: A file of JSON or JSON lines.
    """
    content = _content(path)
    messages = isinstance(content, list) and all(isinstance(m, Mapping) for m in content)
    return bool(messages and content and not _are_runs(content) and _topic_key(content))


def _below(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


def _facts_of(holder: Mapping[str, Any], name: str = "") -> dict[str, Any]:
    """Numbers and texts of an object, and of the objects in it without tables of their own."""
    facts: dict[str, Any] = {}
    for key, value in holder.items():
        field = _below(name, str(key))
        if isinstance(value, Mapping) and not _holds_table(value):
            facts |= _facts_of(value, field)
        elif isinstance(value, (bool, int, float, str)):
            facts[field] = value
    return facts


def _holds_table(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and isinstance(value[0], Mapping)
    return isinstance(value, Mapping) and (
        _is_table(value) or any(_holds_table(inner) for inner in value.values())
    )


def _is_table(value: Mapping[str, Any]) -> bool:
    """Whether an object holds a list of values for each of several columns."""
    lengths = list(map(len, _lists_of(value).values()))
    return max(map(lengths.count, lengths), default=0) > 1 and max(lengths) >= _FEWEST_ROWS


def _are_runs(entries: Sequence[Mapping[str, Any]]) -> bool:
    """Whether objects are runs with lists of values rather than records with vectors, which are
    short and of the same length in each."""
    if not any(_is_table(entry) for entry in entries):
        return False
    lengths = [{name: len(column) for name, column in _lists_of(e).items()} for e in entries]
    return max(lengths[0].values(), default=0) > MOST_ENTRIES or lengths.count(lengths[0]) < len(
        lengths
    )


def _lists_of(value: Mapping[str, Any], name: str = "") -> dict[str, list[Any]]:
    """Lists of an object, and of the objects in it, that are none of objects."""
    found: dict[str, list[Any]] = {}
    for key, inner in value.items():
        field = _below(name, str(key))
        if isinstance(inner, Mapping):
            found |= _lists_of(inner, field)
        elif isinstance(inner, list) and inner and not isinstance(inner[0], Mapping):
            found[field] = inner
    return found


def _arrays_of(value: Mapping[str, Any]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Lists that are columns of one table, as arrays, and a sentence for each of the others."""
    arrays = {name: _array_of(column) for name, column in _lists_of(value).items()}
    shapes = {name: array.shape for name, array in arrays.items() if array is not None}
    used, out = arrays_of_a_table(shapes, "list")
    out += [f"list {name}: rows of several lengths" for name, a in arrays.items() if a is None]
    return {name: array for name in used if (array := arrays[name]) is not None}, out


def _array_of(entries: Sequence[Any]) -> NDArray[Any] | None:
    """A list as an array, of text where one entry is; None: its rows are of several lengths."""
    if any(isinstance(entry, str) for entry in entries):
        return text_of(["" if entry is None else str(entry) for entry in entries])
    try:
        return np.array(entries, dtype=np.float64)
    except (TypeError, ValueError):
        return None
