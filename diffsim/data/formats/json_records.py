"""JSON of loggers: a list of records, or an object with such lists and facts beside them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.data.formats.columns import Columns, fields_left_out, of_messages


def parts(path: Path) -> list[str]:
    """Lists of records by key, ``episode.steps`` where deeper; "" where the file is one."""
    return [name for name, _ in _tables(_content(path), "")]


def read(path: Path, part: str) -> Columns:
    """Columns of a list of records, and one constant column for every fact that stands beside it.

    A fact is a number or text of an object that holds the list; a column of its name goes first.
    """
    content = _content(path)
    records = dict(_tables(content, ""))[part]
    columns = of_messages(records)
    facts: dict[str, Any] = {}
    holder: Any = content
    for key in part.split(".") if part else []:
        facts |= {k: v for k, v in holder.items() if isinstance(v, (bool, int, float, str))}
        holder = holder[key]
    for name, value in facts.items():
        columns.setdefault(name, np.full(len(records), value))
    return {name: v.astype(np.int64) if v.dtype == bool else v for name, v in columns.items()}


def left_out(path: Path, part: str) -> list[str]:
    """Fields of the first record that are no columns."""
    records = dict(_tables(_content(path), "")).get(part, [])
    return list(fields_left_out(records[0])) if records else []


def _content(path: Path) -> Any:
    """The whole file; of JSON lines, which have a record each, a list of them."""
    text = path.read_text("utf-8-sig")
    if path.suffix.lower() == ".jsonl":
        return [json.loads(line) for line in text.splitlines() if line.strip()]
    return json.loads(text)


def _tables(value: Any, name: str) -> Iterator[tuple[str, list[Mapping[str, Any]]]]:
    """Lists of records inside a value, each with the keys that lead to it."""
    if isinstance(value, list):
        if value and all(isinstance(record, Mapping) for record in value):
            yield name, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _tables(inner, f"{name}.{key}" if name else str(key))
