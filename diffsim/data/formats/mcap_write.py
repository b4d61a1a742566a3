"""Tables as MCAP: one topic of JSON messages with their schema, as Foxglove and others read it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.core.version import __version__
from diffsim.data.formats.logs import TABLE
from diffsim.data.formats.messages import CLOCKS, stamps

TOPIC = "/recording"


def write(path: Path, columns: Mapping[str, NDArray[Any]], topic: str = "") -> None:
    """Write a table as a topic with a message per row, empty cells left out.

    Args:
        path: File to write.
        columns: Columns by name, each (num_rows,); ``time_s``, ``t`` or ``time`` [s] is the clock
            of the log, to a nanosecond, and ``time_s`` is written as that clock alone.
        topic: What it is called; empty: "/recording".

    Raises:
        ImportError: mcap is not installed.
        ValueError: no column is the clock, or it does not ascend.
    """
    writer = optional("mcap.writer", purpose="an MCAP file")
    ticks = stamps(columns, 10**9, "an MCAP file")
    cells = {name: values.tolist() for name, values in columns.items() if name != CLOCKS[0]}
    properties = {name: {"type": _kind(columns[name])} for name in cells}
    schema = {"type": "object", "properties": properties}
    with path.open("wb") as file:
        log = writer.Writer(file)
        log.start(library=f"diffsim {__version__}")
        of = log.register_schema(
            name=TABLE, encoding="jsonschema", data=json.dumps(schema).encode()
        )
        channel = log.register_channel(schema_id=of, topic=topic or TOPIC, message_encoding="json")
        for k, stamp in enumerate(ticks.tolist()):
            row = {name: values[k] for name, values in cells.items() if values[k] == values[k]}
            log.add_message(
                channel_id=channel,
                log_time=stamp,
                publish_time=stamp,
                data=json.dumps(row, allow_nan=False).encode(),
            )
        log.finish()


def _kind(values: NDArray[Any]) -> str:
    return {"f": "number", "b": "boolean", "U": "string", "S": "string"}.get(
        values.dtype.kind, "integer"
    )


__all__ = ["TOPIC", "write"]
