"""HDF5, read by h5py: a group with arrays of one length is a table."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.columns import Columns, flat

MAX_DEPTH = 50  # groups inside of each other; a group can hold the one that holds it


def parts(path: Path) -> list[str]:
    """Groups that hold arrays; the file's root is ""."""
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        return [name for name, group in _groups(h5py, "", file) if _arrays(h5py, group)]


def read(path: Path, part: str) -> Columns:
    """Columns of a group: one-dimensional arrays, and rows of larger ones."""
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        arrays = _arrays(h5py, _group(h5py, file, part))
    columns = dict(pair for name, values in arrays.items() for pair in flat(name, values))
    return with_equal_lengths(columns)


def _group(h5py: Any, file: Any, part: str) -> Any:
    """A group by its path, which leads through the file's own groups only."""
    group = file
    for name in filter(None, part.split("/")):
        group = dict(_own(h5py, group)).get(name)
        if not isinstance(group, h5py.Group):
            raise ValueError(f"{file.filename}: has no group {part!r} of its own")
    return group


def write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table as arrays of the root."""
    h5py = _h5py()
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            is_text = values.dtype.kind in "US"
            kind = h5py.string_dtype() if is_text else None
            file.create_dataset(name, data=values.astype(object) if is_text else values, dtype=kind)


def with_equal_lengths(columns: Columns) -> Columns:
    """Without what has another length than most: single numbers beside the samples are settings."""
    lengths = [len(values) for values in columns.values()]
    most = max(lengths, key=lambda n: (lengths.count(n) if n > 1 else 0, n), default=0)
    return {name: values for name, values in columns.items() if len(values) == most}


def _groups(h5py: Any, name: str, group: Any, depth: int = 0) -> Iterator[tuple[str, Any]]:
    if depth > MAX_DEPTH:
        file = group.file.filename
        raise ValueError(f"{file}: more than {MAX_DEPTH} groups inside of each other")
    yield name, group
    for key, inner in _own(h5py, group):
        if isinstance(inner, h5py.Group):
            yield from _groups(h5py, f"{name}/{key}" if name else key, inner, depth + 1)


def _own(h5py: Any, group: Any) -> Iterator[tuple[str, Any]]:
    """What a group itself holds: links, and arrays kept elsewhere, could read any other file."""
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            inner = group[name]
            is_array = isinstance(inner, h5py.Dataset)
            if not (is_array and (inner.external or inner.is_virtual)):
                yield name, inner


def _arrays(h5py: Any, group: Any) -> dict[str, NDArray[Any]]:
    """Arrays of numbers or text of a group; a compound type gives its fields."""
    out: dict[str, NDArray[Any]] = {}
    for name, data in _own(h5py, group):
        if not isinstance(data, h5py.Dataset) or not data.shape:
            continue
        values = data[()]
        if values.dtype.names:
            out |= {f"{name}.{field}": values[field] for field in values.dtype.names}
        elif values.dtype == object:
            out[name] = np.array([v.decode() if isinstance(v, bytes) else str(v) for v in values])
        elif values.dtype.kind in "biufS":
            out[name] = values.astype(str) if values.dtype.kind == "S" else values
    return out


def _h5py() -> Any:
    return optional("h5py", purpose="an HDF5 file")
