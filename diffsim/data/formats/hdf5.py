"""HDF5, read by h5py: a group with arrays of one length is a table."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.optional import optional
from diffsim.data.formats.columns import (
    Columns,
    arrays_of_a_table,
    flat,
    require_few,
    require_room,
    require_text_room,
    text_of,
)

_CLOCK = re.compile(r"(t|time|timestamps?|stamps?|seconds|elapsed)([_\W].*)?", re.I)
_LONGEST_UNIT = 40  # letters


def parts(path: Path, *, upright: bool = False) -> list[str]:
    """Groups that are tables; the file's root is ""."""
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        return [name for name, _ in _tables(h5py, "", file, None, upright, set())]


def read(path: Path, part: str, *, upright: bool = False) -> Columns:
    """Columns of a group: one-dimensional arrays, and rows of larger ones.

    Arrays of groups inside of it belong to it where they have its rows and no clock of their own,
    as the sensors of robomimic's demonstrations have. A unit that an array states is put into the
    name of the column.

    Args:
        path: The file.
        upright: Whether the longer side of a matrix is that of the samples, as in MATLAB's files.
    """
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        group = _group(h5py, file, part)
        found, _ = _sorted_out(h5py, group, upright)
        require_room(path, sum(data.size * data.dtype.itemsize for data in found.values()))
        columns = dict(
            pair for name, data in found.items() for pair in _columns(name, data, upright)
        )
        rate = _rate(group)
    if rate is not None and columns and not any(_CLOCK.fullmatch(name) for name in columns):
        rows = len(next(iter(columns.values())))
        columns = {"time_s": np.arange(rows) / rate, **columns}
    return columns


def left_out(path: Path, part: str, *, upright: bool = False) -> list[str]:
    """Arrays of a group that are none of its table."""
    h5py = _h5py()
    with h5py.File(path, "r") as file:
        return _sorted_out(h5py, _group(h5py, file, part), upright)[1]


def _group(h5py: Any, file: Any, part: str) -> Any:
    """A group by its path, which leads through the file's own groups only."""
    group = file
    for name in filter(None, part.split("/")):
        group = _entry_of(h5py, group, name) if name in group else None
        if not isinstance(group, h5py.Group):
            raise ValueError(f"{file.filename}: has no group {part!r} of its own")
    return group


def write(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write a table as arrays of the root."""
    h5py = _h5py()
    # HDF5 ends the process where a disk gets full, so it writes to memory
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        for name, values in columns.items():
            is_text = values.dtype.kind in "US"
            kind = h5py.string_dtype() if is_text else None
            file.create_dataset(name, data=values.astype(object) if is_text else values, dtype=kind)
        file.flush()
        path.write_bytes(file.id.get_file_image())


def _tables(
    h5py: Any, name: str, group: Any, above: int | None, upright: bool, seen: set[int]
) -> Iterator[tuple[str, Any]]:
    """Groups that are tables of their own, below one whose table has so many rows."""
    place = h5py.h5o.get_info(group.id).addr
    if place in seen:  # a few dozen groups could lead to each other in more ways than can be gone
        raise ValueError(f"group {name!r} holds itself, or stands in two places")
    seen.add(place)
    held = dict(_own(h5py, group))
    arrays = _arrays(h5py, held)
    rows = _rows(arrays)
    if arrays and (upright or above is None or rows != above or _has_clock(arrays)):
        yield name, group
        above = rows
    for key, inner in held.items():
        if isinstance(inner, h5py.Group):
            yield from _tables(h5py, f"{name}/{key}" if name else key, inner, above, upright, seen)


def _sorted_out(h5py: Any, group: Any, upright: bool) -> tuple[dict[str, Any], list[str]]:
    """Arrays of a group and of those inside that belong to it, and what is left out."""
    found: dict[str, Any] = {}
    others: list[str] = []
    _gather(h5py, group, "", found, others, inner=not upright)
    shapes = {n: d.shape[::-1] if upright and _lies(d) else d.shape for n, d in found.items()}
    used, left = arrays_of_a_table(shapes)
    return {name: found[name] for name in used}, [*left, *others]


def _gather(
    h5py: Any,
    group: Any,
    prefix: str,
    found: dict[str, Any],
    others: list[str],
    *,
    inner: bool = True,
) -> None:
    own = dict(_own(h5py, group))
    arrays = _arrays(h5py, own)
    if prefix and (_has_clock(arrays) or (arrays and _rows(arrays) != _rows(found))):
        return  # a table of its own
    found |= {f"{prefix}{name}": data for name, data in arrays.items()}
    others += [
        f"{prefix}{name}: a link, or kept in another file; neither is followed"
        for name in group
        if name not in own and name[:1] != "#"
    ]
    for name, held in own.items():
        if isinstance(held, h5py.Dataset) and name not in arrays:
            others.append(f"array {prefix}{name}: a single value, or neither numbers nor text")
        elif isinstance(held, h5py.Group) and name == "next_obs" and "obs" in own:
            others.append(f"group {prefix}{name}: obs of the next row")
        elif isinstance(held, h5py.Group) and inner:
            _gather(h5py, held, f"{prefix}{name}.", found, others)


def _rows(arrays: Mapping[str, Any]) -> int | None:
    used, _ = arrays_of_a_table({name: data.shape for name, data in arrays.items()})
    return arrays[used[0]].shape[0] if used else None


def _has_clock(arrays: Mapping[str, Any]) -> bool:
    return any(_CLOCK.fullmatch(name) for name in arrays)


def _rate(group: Any) -> float | None:
    """Rows per second, as robomimic states it of the environment; None where nothing does."""
    while True:
        try:
            stated = json.loads(group.attrs.get("env_args", "null"))
            rate = stated["env_kwargs"]["control_freq"]
            return float(rate) if 0.0 < float(rate) < float("inf") else None
        except (TypeError, ValueError, KeyError, RecursionError):
            if group.name == "/":
                return None
            group = group.parent


def _own(h5py: Any, group: Any) -> Iterator[tuple[str, Any]]:
    """What a group itself holds, by name."""
    require_few(len(group), f"entries of a group, {group.name!r}")
    for name in group:
        if (inner := _entry_of(h5py, group, name)) is not None:
            yield name, inner


def _entry_of(h5py: Any, group: Any, name: str) -> Any:
    """What a name of a group holds; None: links, and arrays kept elsewhere, could read any file."""
    if name[:1] == "#" or not isinstance(group.get(name, getlink=True), h5py.HardLink):
        return None  # MATLAB's own records, or a link
    inner = group[name]
    is_array = isinstance(inner, h5py.Dataset)
    return None if is_array and (inner.external or inner.is_virtual) else inner


def _arrays(h5py: Any, held: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays of numbers or text among what a group itself holds, unread."""
    return {
        name: data
        for name, data in held.items()
        if isinstance(data, h5py.Dataset) and data.shape and _is_readable(h5py, data.dtype)
    }


def _is_readable(h5py: Any, kind: Any) -> bool:
    return kind.names is not None or kind.kind in "biufS" or bool(h5py.check_string_dtype(kind))


def _lies(array: Any) -> bool:
    return array.ndim == 2 and array.shape[0] < array.shape[1]


def _columns(name: str, data: Any, upright: bool) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of an array; a compound type gives its fields."""
    values, unit = data[()], _unit(data)
    values = values.T if upright and _lies(values) else values
    if values.dtype.names:
        fields = {f"{name}.{f}": values[f] for f in values.dtype.names}
    elif values.dtype == object:
        text = [v.decode("utf-8", "replace") if isinstance(v, bytes) else str(v) for v in values]
        fields = {name: text_of(text)}
    else:
        is_bytes = values.dtype.kind == "S"
        require_text_room(values.dtype.itemsize if is_bytes else 0, values.size)
        fields = {name: values.astype(str) if is_bytes else values}
    for field, array in fields.items():
        for column, entries in flat(field, array):
            yield f"{column} [{unit}]" if unit else column, entries


def _unit(data: Any) -> str:
    """The unit that an array states as an attribute; empty: none."""
    for key in ("unit", "units", "Unit", "Units"):
        stated = data.attrs.get(key)
        if isinstance(stated, bytes):
            stated = stated.decode("utf-8", "replace")
        if isinstance(stated, str) and 0 < len(stated.strip()) <= _LONGEST_UNIT:
            return stated.strip()
    return ""


def _h5py() -> Any:
    return optional("h5py", purpose="an HDF5 file")
