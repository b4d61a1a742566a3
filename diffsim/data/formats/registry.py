"""Which reader a file has, by its ending."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffsim.core.check import did_you_mean
from diffsim.core.checked import checked
from diffsim.core.files import replacing
from diffsim.data.formats import arrays, hdf5, json_records, logs, mat, parquet
from diffsim.data.formats.columns import Columns, require_few, require_text

Parts = Callable[[Path], list[str]]
Read = Callable[[Path, str], Columns]
LeftOut = Callable[[Path, str], list[str]]
Write = Callable[[Path, Mapping[str, NDArray[Any]]], None]

_READERS: dict[str, tuple[Parts, Read]] = {
    ".parquet": (parquet.parts, parquet.read),
    ".h5": (hdf5.parts, hdf5.read),
    ".hdf5": (hdf5.parts, hdf5.read),
    ".mat": (mat.parts, mat.read),
    ".npz": (arrays.npz_parts, arrays.read_npz),
    ".xlsx": (arrays.xlsx_parts, arrays.read_xlsx),
    ".json": (json_records.parts, json_records.read),
    ".jsonl": (json_records.parts, json_records.read),
    ".ulg": (logs.ulog_parts, logs.read_ulog),
    ".mcap": (logs.mcap_parts, logs.read_mcap),
    ".bag": (logs.rosbag_parts, logs.read_rosbag),
    ".db3": (logs.rosbag_parts, logs.read_rosbag),
}
_LEFT_OUT: dict[str, LeftOut] = {
    ".parquet": parquet.left_out,
    ".h5": hdf5.left_out,
    ".hdf5": hdf5.left_out,
    ".mat": mat.left_out,
    ".npz": arrays.npz_left_out,
    ".xlsx": arrays.xlsx_left_out,
    ".json": json_records.left_out,
    ".jsonl": json_records.left_out,
    ".ulg": logs.ulog_lost,
    ".mcap": logs.mcap_left_out,
    ".bag": logs.rosbag_left_out,
    ".db3": logs.rosbag_left_out,
}
_WRITERS: dict[str, Write] = {
    ".parquet": parquet.write,
    ".h5": hdf5.write,
    ".hdf5": hdf5.write,
    ".mat": mat.write,
}
WRITTEN = tuple(_WRITERS)
"""Formats that ``write_columns`` writes, besides CSV."""

SUFFIXES = tuple(_READERS)
"""Endings of the files that are read by their format's own library."""


@checked
def split_part(path: str | Path) -> tuple[Path, str]:
    """File and part of ``FILE#PART``.

    Args:
        path: As a study names it.

    Returns:
        The file, and the part or "".
    """
    head, _, part = str(path).partition("#")
    return (Path(path), "") if not part and "#" not in str(path) else (Path(head), part)


@checked
def is_container(path: str | Path) -> bool:
    """Whether a file, or a part of one, is of a format with its own library."""
    return split_part(path)[0].suffix.lower() in _READERS


@checked
def parts_of(path: Path) -> list[str]:
    """Tables that a file holds, such as topics, at least one; [""] where it is one table.

    Args:
        path: The file, without a part.

    Raises:
        FileNotFoundError: no such file.
        ImportError: the format's library is not installed.
        ValueError: the file cannot be read, or holds no table.
    """
    parts = _read_guarded(path, lambda: require_text(_list_parts(path, *_state(path))))
    if not parts:
        why = "; ".join(_look_for_left_out(path, "")[:3])
        raise ValueError(f"{path}: holds no table{f': {why}' if why else ''}")
    return list(parts)


@lru_cache(maxsize=64)  # of a file with a thousand tables, each is asked for by its name
def _list_parts(path: Path, size: int, changed_ns: int) -> tuple[str, ...]:
    return tuple(_READERS[path.suffix.lower()][0](path))


def _state(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, found.st_mtime_ns


@checked
def read_columns(path: str | Path) -> Columns:
    """Columns of a table.

    Args:
        path: ``FILE``, or ``FILE#PART`` where the file holds several tables.

    Returns:
        Columns by name, each (num_rows,).

    Raises:
        FileNotFoundError: no such file.
        ImportError: the format's library is not installed.
        ValueError: the file cannot be read, or holds several tables, or not this one.
    """
    file, part = _part_of(path)

    def read() -> Columns:
        found = _READERS[file.suffix.lower()][1](file, part)
        require_few(len(found))
        require_text(found, *found.values())
        return found

    columns = _read_guarded(file, read)
    lengths = {len(values) for values in columns.values()}
    if not columns or lengths == {0}:
        raise ValueError(f"{path}: no rows")
    if len(lengths) > 1:
        raise ValueError(f"{path}: columns of different lengths {sorted(lengths)}; name a part")
    return columns


@checked
def left_out_of(path: str | Path) -> list[str]:
    """What a file holds, or once held, and its table does not have, a sentence each.

    Args:
        path: As ``read_columns`` has it.
    """
    file, part = _part_of(path)
    return [f"{file.name}: {sentence}" for sentence in _look_for_left_out(file, part)]


def _look_for_left_out(file: Path, part: str) -> list[str]:
    look = _LEFT_OUT.get(file.suffix.lower())
    return [] if look is None else _read_guarded(file, lambda: look(file, part))


def _part_of(path: str | Path) -> tuple[Path, str]:
    """The file and the part that is meant, which is there."""
    file, part = split_part(path)
    parts = parts_of(file)
    if not part and len(parts) == 1:
        part = parts[0]
    is_whole = not part and _READERS[file.suffix.lower()][1] is json_records.read
    is_known = part in parts or (is_whole and json_records.is_log(file))
    if not is_known and not (file.suffix.lower() == ".mat" and mat.has_part(file, part)):
        shown = ", ".join(f"{file.name}#{p}".removesuffix("#") for p in parts[:30])
        what = f"has no part {part!r}{did_you_mean(part, parts)}" if part else "holds several parts"
        raise ValueError(f"{file}: {what}; name one as FILE#PART: {shown}")
    return file, part


@checked
def write_columns(path: str | Path, columns: Mapping[str, NDArray[Any]]) -> Path:
    """Write a table, in place of an older one only when it is whole.

    Args:
        path: Its ending tells the format.
        columns: Columns by name, each (num_rows,).

    Returns:
        The file that was written.

    Raises:
        ImportError: the format's library is not installed.
        ValueError: a format that is not written, or what it cannot hold.
    """
    file, part = split_part(path)
    suffix = file.suffix.lower()
    if suffix not in WRITTEN:
        raise ValueError(f"{file}: tables are written as .csv, {', '.join(WRITTEN)}")
    if part:
        raise ValueError(f"{path}: {suffix} is written as one table; name the file without #{part}")
    arrays = {name: np.asarray(values) for name, values in columns.items()}
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file, suffix) as beside:
        _WRITERS[suffix](beside, arrays)
    return file


@checked
def renamed(path: str | Path, columns: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    """Columns whose name a format spells in its own way.

    Args:
        path: As ``write_columns`` has it.
        columns: Columns by name, each (num_rows,).

    Returns:
        The name in the file by that of the column, where they differ.
    """
    if split_part(path)[0].suffix.lower() != ".mat":
        return {}
    names = {name: mat.word(name) for name in columns}
    return {name: new for name, new in names.items() if new != name}


def _read_guarded(path: Path, read: Callable[[], Any]) -> Any:
    """What a library throws at a damaged file, as one error that names the file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return read()
    except ImportError:
        raise
    except MemoryError as error:  # what it claims to hold, or holds
        raise ValueError(f"{path}: needs more memory than there is") from error
    except RecursionError as error:
        raise ValueError(
            f"{path}: cannot be read as {path.suffix}: it describes records inside of each other "
            "without end"
        ) from error
    except Exception as error:  # each library has its own
        said = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{path}: cannot be read as {path.suffix}: {said}") from error
