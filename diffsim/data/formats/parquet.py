"""Apache Parquet, read by pyarrow."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.columns import Columns


def parts(path: Path) -> list[str]:
    """One table."""
    _pyarrow().ParquetFile(path).close()
    return [""]


def read(path: Path, part: str) -> Columns:
    """Columns of the table; nulls of numbers are NaN, times are seconds since 1970."""
    table = _pyarrow().read_table(path)
    out = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        values = column.to_numpy()
        if np.issubdtype(values.dtype, np.datetime64):
            values = values.astype("datetime64[ns]").astype(np.int64) * 1e-9
        elif values.dtype == object:
            cells = [None if v is None else v for v in values]
            text = any(isinstance(v, str) for v in cells)
            values = (
                np.array(["" if v is None else str(v) for v in cells])
                if text
                else np.array([np.nan if v is None else float(v) for v in cells])
            )
        out[name] = values
    return out


def write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table."""
    pyarrow = optional("pyarrow", purpose=f"writing {path.suffix}")
    table = pyarrow.table({name: pyarrow.array(values) for name, values in columns.items()})
    _pyarrow().write_table(table, path)


def _pyarrow() -> Any:
    return optional("pyarrow.parquet", purpose="a Parquet file")
