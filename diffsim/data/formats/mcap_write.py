"""Tables as MCAP: one topic of JSON messages with their schema, as Foxglove and others read it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.core.version import __version__

TOPIC = "/recording"
CLOCKS = ("time_s", "t", "time")
"""Columns that may be the clock of the messages, the first that is there."""


def write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table as topic ``/recording``: a message per row, empty cells left out.

    Args:
        path: File to write.
        columns: Columns by name, each (num_rows,); ``time_s``, ``t`` or ``time`` [s] is the clock
            of the log, and ``time_s`` is written as that clock alone.

    Raises:
        ImportError: mcap is not installed.
        ValueError: no column is the clock, or it does not ascend.
    """
    writer = optional("mcap.writer", purpose="an MCAP file")
    stamps = _stamps(columns)
    cells = {name: values.tolist() for name, values in columns.items() if name != CLOCKS[0]}
    properties = {name: {"type": _kind(columns[name])} for name in cells}
    schema = {"type": "object", "properties": properties}
    with path.open("wb") as file:
        log = writer.Writer(file)
        log.start(library=f"diffsim {__version__}")
        of = log.register_schema(
            name="diffsim.Recording", encoding="jsonschema", data=json.dumps(schema).encode()
        )
        channel = log.register_channel(schema_id=of, topic=TOPIC, message_encoding="json")
        for k, stamp in enumerate(stamps.tolist()):
            row = {name: values[k] for name, values in cells.items() if values[k] == values[k]}
            log.add_message(
                channel_id=channel,
                log_time=stamp,
                publish_time=stamp,
                data=json.dumps(row, allow_nan=False).encode(),
            )
        log.finish()


def _stamps(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Nanoseconds of the rows, from 0."""
    name = next((c for c in CLOCKS if c in columns), None)
    if name is None:
        raise ValueError(
            f"an MCAP file needs a clock: a column {', '.join(CLOCKS[:-1])} or {CLOCKS[-1]} in "
            f"seconds, got {', '.join(columns)}"
        )
    time = np.asarray(columns[name], dtype=np.float64)
    if not np.isfinite(time).all() or (np.diff(time) < 0.0).any():
        raise ValueError(f"column {name}, the clock of the MCAP file, must be finite and ascend")
    return np.round((time - time[0]) * 1e9).astype(np.int64)


def _kind(values: NDArray[Any]) -> str:
    return {"f": "number", "b": "boolean", "U": "string", "S": "string"}.get(
        values.dtype.kind, "integer"
    )


__all__ = ["CLOCKS", "TOPIC", "write"]
