"""A log on disk, one JSON line per evaluation: an interrupted search goes on from it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from diffsim.core.arrays import Array
from diffsim.core.checked import checked, checked_methods
from diffsim.core.files import append_atomic, to_plain, write_bytes_atomic
from diffsim.optim.evaluation import Evaluation

FORMAT = "diffsim.optim.log"
VERSION = 1


class LogError(ValueError):
    """A file that a log cannot go on from; the message says why and what to do."""


@checked_methods
class Log:
    """Entries in named lists; each is on disk before ``append`` returns, none is ever changed.

    The first line names the format and the settings. A last line that an interruption cut off is
    dropped when the file is opened again. One process at a time may write.

    Args:
        path: File of JSON lines; None keeps the entries in memory only.
        settings: Settings that the entries depend on, of plain types; a file of other settings is
            refused.

    Raises:
        LogError: the file holds entries of other settings, is of an older version of diffsim, is
            no log at all, or a line in its midst is damaged.
    """

    @checked
    def __init__(self, path: str | Path | None = None, settings: Mapping[str, Any] | None = None):
        self.path = None if path is None else Path(path)
        self.settings: dict[str, Any] = json.loads(json.dumps(to_plain(dict(settings or {}))))
        self._lists: dict[str, list[dict[str, Any]]] = {}
        self._at: dict[tuple[str, bytes], dict[str, Any]] = {}
        self._has_header = False
        if self.path is not None and self.path.exists():
            self._read(self.path)

    def __getitem__(self, name: str) -> Sequence[Mapping[str, Any]]:
        """Entries of a list, in order; empty where there is none."""
        return tuple(self._lists.get(name, ()))

    def find(self, name: str, x: Array) -> Mapping[str, Any] | None:
        """The entry of a list at the point x, (n,), the same to the last bit; None if none is."""
        return self._at.get(_key(name, x))

    def append(self, name: str, entry: Mapping[str, Any]) -> Mapping[str, Any]:
        """Add an entry to a list, and to the file.

        Args:
            name: Name of the list that the entry is appended to.
            entry: Entry of plain types, arrays and NumPy's numbers; if it has a point "x", ``find``
                looks it up by that.

        Returns:
            The entry as it will be read back.
        """
        line = json.dumps(to_plain({"list": name, **entry}), ensure_ascii=False, allow_nan=False)
        if self.path is not None:
            header = "" if self._has_header else self._header()
            append_atomic(self.path, f"{header}{line}\n".encode())
            self._has_header = True
        return self._keep(json.loads(line))

    def part(self, name: str) -> Log:
        """A log in memory that holds one list only: what a worker goes on from."""
        out = Log()
        for entry in self[name]:
            out.append(name, entry)
        return out

    def take(self, name: str, part: Log) -> None:
        """Add what a worker appended to the list since ``part`` was made."""
        for entry in part[name][len(self[name]) :]:
            self.append(name, entry)

    def _keep(self, entry: dict[str, Any]) -> dict[str, Any]:
        name = entry.pop("list")
        self._lists.setdefault(name, []).append(entry)
        if "x" in entry:
            self._at[_key(name, np.array(entry["x"], dtype=np.float64))] = entry
        return entry

    def _header(self) -> str:
        head = {"format": FORMAT, "version": VERSION, "settings": self.settings}
        return json.dumps(head, ensure_ascii=False) + "\n"

    def _read(self, path: Path) -> None:
        content = path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if not whole and self._header().encode().startswith(content):  # cut off in the first line
            write_bytes_atomic(path, b"")
            return
        lines = whole.split(b"\n")[:-1]
        self._check_header(path, content, lines)
        for number, line in enumerate(lines[1:], start=2):
            try:
                self._keep(json.loads(line))
            except (ValueError, KeyError) as error:
                raise LogError(f"{path}, line {number}, is damaged: {error}") from error
        if whole != content:
            write_bytes_atomic(path, whole)
        self._has_header = True

    def _check_header(self, path: Path, content: bytes, lines: Sequence[bytes]) -> None:
        head = _parse_line(lines[0]) if lines else None
        again = "delete it, or choose another path"
        if head is None or head.get("format") != FORMAT:
            what = "is no log of evaluations"
            if _of_an_older_version(content, head):
                what = (
                    "was written by an older version of diffsim, which kept evaluations otherwise"
                )
            raise LogError(f"{path} {what}; {again}")
        if head.get("version") != VERSION:
            raise LogError(f"{path} is of version {head.get('version')}, not {VERSION}; {again}")
        if head.get("settings") != self.settings:
            raise LogError(
                f"{path} belongs to another run, one of {head.get('settings')}, not of "
                f"{self.settings}; {again}"
            )


def entry_of(evaluation: Evaluation) -> dict[str, Any]:
    """An evaluation as an entry of a log; a failed one has no value."""
    return {
        "x": evaluation.x,
        "value": None if evaluation.failure else evaluation.value,
        "gradient": evaluation.gradient,
        "failure": evaluation.failure,
        "wall_s": evaluation.wall_s,
        "cpu_s": evaluation.cpu_s,
        "notes": dict(evaluation.notes),
    }


def evaluation_of(entry: Mapping[str, Any]) -> Evaluation:
    """The reverse of ``entry_of``; equal to the last bit, notes in plain types."""
    gradient = entry["gradient"]
    return Evaluation(
        x=np.array(entry["x"], dtype=np.float64),
        value=np.inf if entry["value"] is None else entry["value"],
        gradient=None if gradient is None else np.array(gradient, dtype=np.float64),
        failure=entry["failure"],
        wall_s=entry["wall_s"],
        cpu_s=entry["cpu_s"],
        notes=entry["notes"],
    )


def _key(name: str, x: Array) -> tuple[str, bytes]:
    return name, np.asarray(x, dtype=np.float64).tobytes()


def _parse_line(text: bytes) -> dict[str, Any] | None:
    try:
        value = json.loads(text)
    except ValueError:
        return None
    return value if isinstance(value, dict) else None


def _of_an_older_version(content: bytes, head: Mapping[str, Any] | None) -> bool:
    """Devices kept one JSON document, applications lines without a header."""
    if head is not None:
        return "with_gradient" in head
    document = _parse_line(content)
    return document is not None and "settings" in document
