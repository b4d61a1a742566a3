"""Tables as PX4 ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format.html), by pyulog."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.messages import CLOCKS, Field, Record, fields_of, names_of, stamps

TOPIC = "recording"
STAMP = "timestamp"  # the clock of every topic [us]
_START = 8  # byte of the header at which the time of the log's start stands
_MOST = 2**16 - 1  # bytes of a message
_TOPIC = re.compile(r"[A-Za-z0-9_\-/]+")
_TYPES = {
    "f8": "double", "f4": "float", "b1": "bool",
    **{f"{sign}{size}": f"{'u' if sign == 'u' else ''}int{8 * size}_t"
       for sign in "iu" for size in (1, 2, 4, 8)},
}  # fmt: skip


def write(path: Path, columns: Mapping[str, NDArray[Any]], topic: str = "") -> None:
    """Write a table as a topic with a message per row.

    Args:
        path: File to write.
        columns: Columns by name, each (num_rows,); ``time_s``, ``t`` or ``time`` [s] is the clock,
            to a microsecond, and ``time_s`` is written as that clock alone. Integers in
            ``timestamp`` [us] are the clock's own.
        topic: What it is called; empty: "recording".

    Raises:
        ImportError: pyulog is not installed.
        ValueError: no clock, text, or a name that the format does not have.
    """
    pyulog = optional("pyulog", purpose="a PX4 log")
    topic = topic or TOPIC
    if not _TOPIC.fullmatch(topic):
        raise ValueError(f"topic {topic!r}: PX4 logs take letters, digits, _, - and /")
    ticks = _ticks(columns)
    held = {n: v for n, v in columns.items() if n not in (CLOCKS[0], STAMP)}
    types = {name: _type_of(name, values) for name, values in held.items()}
    fields = fields_of(held, word)
    log = pyulog.ULog(None)
    for name, text in _formats(topic, fields, types):
        log.message_formats[name] = pyulog.ULog.MessageFormat(f"{name}:{text}".encode(), None)
    order = [(STAMP, "uint64_t", ticks)]
    order += [(name, types[name], held[name]) for name in names_of(fields)]
    log.data_list.append(pyulog.ULog.Data(_subscription(topic, order)))
    content = io.BytesIO()
    log.write_ulog(content)
    file = bytearray(content.getbuffer())
    struct.pack_into("<Q", file, _START, int(ticks[0]))
    path.write_bytes(file)


def word(name: str) -> str:
    """A name as PX4 logs have fields: letters, digits and underscores, a letter first."""
    spelled = re.sub(r"[^A-Za-z0-9_]", "_", name)
    return spelled if spelled[:1].isalpha() else f"x{spelled}"


def _ticks(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.uint64]:
    """Microseconds of the rows."""
    own = columns.get(STAMP)
    if own is None:
        return stamps(columns, 10**6, "a PX4 log").astype(np.uint64)
    if own.dtype.kind not in "iu" or (own < 0).any() or (own[1:] < own[:-1]).any():
        raise ValueError(
            f"column {STAMP} is the clock of a PX4 log: it must hold integers [us] that ascend; "
            "rename it where it is something else"
        )
    elapsed = (own - own[0]).astype(np.int64)
    if CLOCKS[0] in columns:
        off = np.abs(stamps(columns, 10**6, "a PX4 log") - elapsed)
        if (off > 1).any():
            raise ValueError(
                f"columns {CLOCKS[0]} and {STAMP} are different clocks: row {np.argmax(off > 1)}, "
                f"from 0, differs by {off[off > 1][0]} us; drop or rename one"
            )
    return own.astype(np.uint64)


def _type_of(name: str, values: NDArray[Any]) -> str:
    kind = f"{values.dtype.kind}{values.dtype.itemsize}"
    if kind not in _TYPES:
        raise ValueError(
            f"column {name}: PX4 logs hold numbers, got {values.dtype}; write .mcap, or leave the "
            "column out"
        )
    return _TYPES[kind]


def _formats(
    name: str, fields: Sequence[Field | Record], types: Mapping[str, str], *, is_topic: bool = True
) -> Iterator[tuple[str, str]]:
    """Formats by name: of the records inside first, as a reader needs them."""
    lines = [f"uint64_t {STAMP};"] if is_topic else []
    for field in fields:
        if isinstance(field, Record):
            inner = f"{name}_{field.name}"
            yield from _formats(inner, field.fields, types, is_topic=False)
            lines.append(f"{inner} {field.name};")
        else:
            size = f"[{len(field.columns)}]" if field.is_list else ""
            lines.append(f"{types[field.columns[0]]}{size} {field.name};")
    text = "".join(lines)
    if len(name) + 1 + len(text) > _MOST:
        raise ValueError(f"topic {name}: too many columns for a PX4 log; write .mcap or .parquet")
    yield name, text


def _subscription(topic: str, order: Sequence[tuple[str, str, NDArray[Any]]]) -> SimpleNamespace:
    """What pyulog makes of a topic's messages when it reads them."""
    kinds = [(name, values.dtype.newbyteorder("<")) for name, _, values in order]
    rows = np.empty(len(order[0][2]), dtype=kinds)
    for name, _, values in order:
        rows[name] = values
    if rows.dtype.itemsize + 2 > _MOST:
        raise ValueError(f"topic {topic}: too many columns for a PX4 log; write .mcap or .parquet")
    return SimpleNamespace(
        multi_id=0,
        msg_id=0,
        message_name=topic,
        field_data=[SimpleNamespace(field_name=name, type_str=kind) for name, kind, _ in order],
        timestamp_idx=0,
        buffer=rows.tobytes(),
        dtype=rows.dtype,
    )


__all__ = ["TOPIC", "word", "write"]
