"""Apache Parquet, read by pyarrow."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.columns import MOST_ENTRIES, Columns, flat, require_few, require_room
from diffsim.data.formats.lerobot import COUNTERS, STAMPS, Info, info_of

_ROW_NUMBERS = re.compile(r"__index_level_\d+__")  # pandas' name of an index without one


def parts(path: Path) -> list[str]:
    """One table."""
    with _pyarrow().ParquetFile(path) as file:
        require_few(width := len(file.schema_arrow.names))
        require_room(path, 8 * width * file.metadata.num_rows)
    return [""]


def read(path: Path, part: str) -> Columns:
    """Columns of the table; nulls of numbers are NaN, times are seconds since 1970.

    A list of numbers is a column for each entry, which LeRobot's datasets name.
    """
    table, info = _pyarrow().read_table(path, page_checksum_verification=True), info_of(path)
    out: Columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if not _why_not(name, column.type):
            out |= dict(_columns(name, column, info))
    return out if info is None else _with_clock(out, info)


def _with_clock(columns: Columns, info: Info) -> Columns:
    """Columns of a dataset of LeRobot: its stamps are seconds, else its frames count."""
    others = {name: v for name, v in columns.items() if name not in (STAMPS, *COUNTERS)}
    if STAMPS in columns:
        return {"time_s": columns[STAMPS].astype(np.float64), **others}
    if info.fps is not None and COUNTERS[0] in columns:
        return {"time_s": columns[COUNTERS[0]] / info.fps, **others}
    return columns


def left_out(path: Path, part: str) -> list[str]:
    """Columns that are none of a recording."""
    schema = _pyarrow().read_schema(path)
    why = {name: _why_not(name, schema.field(name).type) for name in schema.names}
    if info_of(path) is not None:
        why |= {name: "counts rows" for name in COUNTERS if name in why}
    return [f"column {name}: {reason}" for name, reason in why.items() if reason]


def _why_not(name: str, kind: Any) -> str:
    """Why a column is not read; empty: it is."""
    types = optional("pyarrow", purpose="a Parquet file").types
    if _ROW_NUMBERS.fullmatch(name) and types.is_integer(kind):
        return "numbers of rows, which pandas adds"
    if _is_list(types, kind):
        long = types.is_fixed_size_list(kind) and kind.list_size > MOST_ENTRIES
        inner = kind.value_type
        if long or not (types.is_floating(inner) or types.is_integer(inner)):
            return f"{kind} is no row of up to {MOST_ENTRIES} numbers"
    elif types.is_nested(kind) or types.is_binary(kind) or types.is_large_binary(kind):
        return f"{kind} is no number"
    return ""


def _is_list(types: Any, kind: Any) -> bool:
    return bool(types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind))


def _columns(name: str, column: Any, info: Info | None) -> Iterator[tuple[str, NDArray[Any]]]:
    values = column.to_numpy()
    if _is_list(optional("pyarrow", purpose="a Parquet file").types, column.type):
        yield from _entries(name, values, info)
    elif np.issubdtype(values.dtype, np.datetime64):
        yield name, values.astype("datetime64[ns]").astype(np.int64) * 1e-9
    elif values.dtype == object and any(isinstance(v, str) for v in values):
        yield name, np.array(["" if v is None else str(v) for v in values])
    elif values.dtype == object:
        yield name, np.array([np.nan if v is None else float(v) for v in values])
    else:
        yield name, values


def _entries(
    name: str, rows: NDArray[Any], info: Info | None
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of lists of one length; a missing list is a gap."""
    lengths = {len(row) for row in rows if row is not None}
    if len(lengths) != 1 or (width := lengths.pop()) > MOST_ENTRIES:
        return  # of no length that a table has; an empty one has no entries
    gap = np.full(width, np.nan)
    whole = np.array([gap if row is None else row for row in rows])
    names = info.names.get(name, ()) if info is not None else ()
    if len(names) == width:
        for k, entry in enumerate(names):
            yield f"{name}.{entry}", whole[:, k]
    else:
        yield from flat(name, whole)


def write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table."""
    pyarrow = optional("pyarrow", purpose=f"writing {path.suffix}")
    table = pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()})
    _pyarrow().write_table(table, path)


def _pyarrow() -> Any:
    return optional("pyarrow.parquet", purpose="a Parquet file")
