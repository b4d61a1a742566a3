"""Atomic writes: a file is either the old one or the whole new one, whatever interrupts."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

CODE = (".py", ".so", ".pyd", ".j2", ".js", ".yaml")
"""Endings of files that decide what the package computes and writes."""
_MOST_TIMES = 50  # the bytes of a packed file; indices of a regular grid pack 10 to 20 times


@contextmanager
def replacing(path: str | Path, suffix: str = ".tmp") -> Iterator[Path]:
    """A temporary file beside ``path``, renamed to it when the block ends without an error.

    Args:
        path: File that is replaced; its folder is made.
        suffix: Ending of the temporary file's name, for writers that choose a format by it.

    Yields:
        The temporary file, empty; it is removed if the block raises.

    Raises:
        OSError: the disk is full, or another reason; it names ``path``.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _name_in_errors(path):
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        with _name_in_errors(path, temporary):
            yield temporary
            os.chmod(temporary, 0o644)  # mkstemp makes files that only their owner can read
            os.replace(temporary, path)
    except BaseException:  # KeyboardInterrupt too: leave no half-written file behind
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def _name_in_errors(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Errors of the system say which file they are about: that of a full disk names none."""
    try:
        yield
    except OSError as error:
        if temporary is not None and error.filename not in (None, str(temporary)):
            raise  # about another file, such as one that is read
        if error.errno is None:  # of a library
            raise OSError(f"cannot write {path}: {error}") from error
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_bytes_atomic(path: str | Path, content: bytes) -> Path:
    """Write ``content`` beside ``path``, flush it to disk, then rename it into place."""
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    return Path(path)


def append_atomic(path: str | Path, content: bytes) -> None:
    """Write at the end of a file and flush it to disk; if that fails, the file is as it was."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _name_in_errors(path), path.open("ab", buffering=0) as file:
        size = file.seek(0, os.SEEK_END)
        left = memoryview(content)
        try:
            while left:  # a disk that gets full takes a part, without an error
                left = left[file.write(left) :]
            os.fsync(file.fileno())
        except OSError:
            file.truncate(size)
            raise


def write_text_atomic(path: str | Path, text: str) -> Path:
    """``write_bytes_atomic`` of UTF-8 text."""
    return write_bytes_atomic(path, text.encode("utf-8"))


def csv_text(header: Iterable[str], rows: Iterable[Iterable[Any]], form: str = "") -> str:
    """A table as CSV: NaN is an empty cell, what holds a comma stands in quotes.

    Args:
        header: Names of the columns.
        rows: Cells of each row.
        form: How floats are written, such as ".9g"; empty: so that they are read as they were.
    """

    def cell(value: Any) -> str:
        if not isinstance(value, float):
            return str(value)
        return "" if math.isnan(value) else format(value, form) if form else repr(float(value))

    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(map(cell, row) for row in rows)
    return text.getvalue()


def write_json_atomic(path: str | Path, value: Any) -> Path:
    """Write strict JSON; numpy scalars, arrays and paths are converted, NaN becomes null."""
    text = json.dumps(to_plain(value), indent=2, ensure_ascii=False, allow_nan=False)
    return write_text_atomic(path, text + "\n")


def read_kept(path: Path) -> dict[str, Any] | None:
    """A result that was kept as JSON; None where there is none, or half of one."""
    try:
        kept: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, json.JSONDecodeError):
        return None
    return kept


def most_unpacked(path: Path, least: int) -> int:
    """Bytes that the content of a packed file may take: a constant of any length takes it none.

    Args:
        least: Of a file however small; of a larger one it is fifty times its own bytes, as what is
            recorded or meshed is not compressed as far.
    """
    return max(least, _MOST_TIMES * path.stat().st_size)


def digest_of(value: Any) -> str:
    """SHA-256 of what ``write_json_atomic`` can write."""
    text = json.dumps(to_plain(value), sort_keys=True)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def file_digest(paths: Iterable[Path]) -> str:
    """SHA-256 over the contents of files, in the order given."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def code_digest(*folders: Path) -> str:
    """SHA-256 of the package as installed (sources, tables, compiled parts) and of further folders.

    What is kept on disk is of the code that made it: a version says less, as a clone's code
    changes within one.
    """
    package = Path(__file__).parents[1]
    found = (path for folder in (package, *folders) for path in folder.rglob("*"))
    return file_digest(sorted(path for path in found if path.suffix in CODE))


def to_plain(value: Any, *, keep_nan: bool = False) -> Any:
    """The same value in types that JSON has; NaN and infinity become None (JSON has neither).

    Args:
        value: Mappings, lists, arrays, numbers, text, paths and dataclasses of these.
        keep_nan: Whether NaN and infinity stay, for YAML.
    """
    if isinstance(value, dict):
        return {str(key): to_plain(item, keep_nan=keep_nan) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(item, keep_nan=keep_nan) for item in value]
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist(), keep_nan=keep_nan)
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if keep_nan or math.isfinite(value) else None
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, Path):
        return str(value)
    if is_dataclass(value) and not isinstance(value, type):
        return to_plain({f.name: getattr(value, f.name) for f in fields(value)}, keep_nan=keep_nan)
    raise TypeError(
        f"cannot write {type(value).__name__} to JSON; convert it to numbers, lists or dicts first"
    )
