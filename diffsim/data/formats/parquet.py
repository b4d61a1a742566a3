"""Apache Parquet, read by pyarrow."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.columns import (
    LETTER,
    MOST_ENTRIES,
    Columns,
    flat,
    require_few,
    require_room,
    require_text_room,
    text_of,
)
from diffsim.data.formats.lerobot import COUNTERS, STAMPS, Info, info_of

_ROW_NUMBERS = re.compile(r"__index_level_\d+__")  # pandas' name of an index without one


def parts(path: Path) -> list[str]:
    """One table."""
    with _pyarrow().ParquetFile(path) as file:
        require_few(len(file.schema_arrow.names))
    return [""]


def read(path: Path, part: str) -> Columns:
    """Columns of the table; nulls of numbers are NaN, times are seconds since 1970.

    A list of numbers is a column for each entry, which LeRobot's datasets name.
    """
    types, info = _types(), info_of(path)
    kinds = {field.name: field.type for field in _pyarrow().read_schema(path)}
    names = [name for name, kind in kinds.items() if not _why_not(name, kind)]
    texts = [n for n in names if types.is_string(kinds[n]) or types.is_large_string(kinds[n])]
    # a text that stands in each of a million rows is kept once
    options = {"page_checksum_verification": True, "read_dictionary": texts}
    with _pyarrow().ParquetFile(path, **options) as file:
        require_room(path, _bytes_of(file.metadata, set(names)))
        table = file.read(names)
    out: Columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        out |= dict(_columns(name, column, info))
    return out if info is None else _with_clock(out, info)


def _bytes_of(about: Any, names: set[str]) -> int:
    """What columns unpack to: the file counts the entries of lists, and bytes of each word once."""
    parts = [about.schema.column(k).path.split(".") for k in range(about.num_columns)]
    above = [{".".join(path[: n + 1]) for n in range(len(path))} for path in parts]
    wanted = [k for k, paths in enumerate(above) if paths & names]
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    found = [group.column(k) for group in groups for k in wanted]
    return sum(max(8 * part.num_values, part.total_uncompressed_size) for part in found)


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
    types = _types()
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
    types = _types()
    if types.is_dictionary(column.type):
        inner = column.type.value_type
        is_text = types.is_string(inner) or types.is_large_string(inner)
        column = column if is_text and column.null_count < len(column) else column.cast(inner)
    if types.is_dictionary(column.type):
        yield name, _texts(column)
    elif _is_list(types, column.type):
        yield from _entries(name, column, info)
    elif types.is_decimal(column.type):
        yield name, column.cast("float64").to_numpy()
    elif np.issubdtype((values := column.to_numpy()).dtype, np.datetime64):
        yield name, values.astype("datetime64[ns]").astype(np.int64) * 1e-9
    elif values.dtype == object:
        yield name, np.array([np.nan if v is None else float(v) for v in values])
    else:
        yield name, values


def _texts(column: Any) -> NDArray[Any]:
    """Text of the words of a dictionary; a missing one is empty."""
    column = column.unify_dictionaries()
    words = text_of([word or "" for word in column.chunk(0).dictionary.to_pylist()] + [""])
    require_text_room(words.dtype.itemsize // LETTER, len(column))
    missing = len(words) - 1
    rows = [chunk.indices.cast("int64").fill_null(missing).to_numpy() for chunk in column.chunks]
    return words[np.concatenate(rows)]


def _entries(name: str, column: Any, info: Info | None) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of lists of one length; a missing list is a gap."""
    compute = optional("pyarrow.compute", purpose="a Parquet file")
    lengths = compute.list_value_length(column).drop_null().unique().to_pylist()
    if len(lengths) != 1 or not 0 < (width := lengths[0]) <= MOST_ENTRIES:
        return  # of no length that a table has; an empty one has no entries
    whole = compute.list_flatten(column).to_numpy().reshape(-1, width)
    if column.null_count:
        entries, whole = whole, np.full((len(column), width), np.nan)
        whole[column.is_valid().to_numpy()] = entries
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


def _types() -> Any:
    return optional("pyarrow", purpose="a Parquet file").types


def _pyarrow() -> Any:
    return optional("pyarrow.parquet", purpose="a Parquet file")
