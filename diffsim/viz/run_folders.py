"""Folders of runs: what each is, how far it is, which pages, pictures and recordings it has.

Files are recognized by the names that the commands give them; nothing is computed or changed.
Runs go on, and may be anybody's: what vanishes meanwhile is left out, what cannot be read is
said, and what lies elsewhere is not looked at.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

PAGES, PICTURES, RECORDINGS = (".html",), (".png", ".svg", ".gif"), (".rrd",)
_MOST_BYTES = 100_000_000  # of a table whose rows are counted
_HEAD = 1_000_000  # bytes of a report that are read: what is said stands before the tables
_TAIL = 200_000  # bytes of a table of progress in which its last row is
_MOST_LETTERS = 2_000  # of a sentence


@dataclass(frozen=True)
class RunFolder:
    """One run."""

    path: str  # folder, relative to the folder of all runs
    kind: str  # such as "diagnosis"; "files" where it is not recognized
    said: str  # result of the run, in one line
    progress: str  # how far it is: "finished", or what is done so far
    changed: float  # time of the last change [s since 1970]
    files: tuple[str, ...]  # all files in it that a browser or a viewer shows, by name

    def of_kind(self, endings: tuple[str, ...]) -> list[str]:
        """Files with one of the endings."""
        return [name for name in self.files if name.lower().endswith(endings)]


def run_folders(root: Path) -> list[RunFolder]:
    """All runs below a folder, the latest first."""
    root = root.resolve()
    made: list[RunFolder | None] = []
    for name, inner, _ in os.walk(root):  # follows no links, and what vanishes meanwhile is none
        folder = Path(name)
        inner[:] = [] if _is_site(folder) else sorted(n for n in inner if n[:1] != ".")
        made.append(_run_folder(root, folder))
    return sorted((m for m in made if m is not None), key=lambda run: -run.changed)


def _is_site(folder: Path) -> bool:
    """Whether it holds a built site, such as that of the documentation: one page leads to all."""
    return all((folder / name).is_file() for name in ("index.html", "404.html"))


def _run_folder(root: Path, folder: Path) -> RunFolder | None:
    stamps = dict(sorted(_stamps(root, folder)))
    shown = tuple(n for n in stamps if n.lower().endswith((*PAGES, *PICTURES, *RECORDINGS)))
    kind = next((kind for marker, kind in _KINDS.items() if marker in stamps), None)
    if kind is None and _is_site(folder):
        shown, kind = ("index.html",), "site"
    if kind is None and not shown:
        return None
    said, progress = "", "finished"
    if kind is not None:
        try:
            said, progress = _tell(folder, kind, tuple(stamps.items()))
        except Exception as error:  # one file of anybody's must not hide all other runs
            said, progress = f"cannot be read: {type(error).__name__}", "unknown"
    changed = max(changed_ns for _, changed_ns in stamps.values()) / 1e9
    relative = folder.relative_to(root).as_posix()
    return RunFolder(relative, kind or "files", said[:_MOST_LETTERS], progress, changed, shown)


def _stamps(root: Path, folder: Path) -> Iterator[tuple[str, tuple[int, int]]]:
    """Files of a folder that lie below the root, with size [bytes] and time of change [ns]."""
    try:
        entries = list(os.scandir(folder))
    except OSError:  # vanished, or not ours to read
        return
    for entry in entries:
        try:
            found = entry.stat()
            inside = not entry.is_symlink() or Path(entry.path).resolve().is_relative_to(root)
        except (OSError, RuntimeError):  # vanished, or links in a circle
            continue
        if entry.name[:1] != "." and stat.S_ISREG(found.st_mode) and inside:
            yield entry.name, (found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=4096)  # runs that have ended are read once, not on every visit of the page
def _tell(
    folder: Path, kind: str, stamps: tuple[tuple[str, tuple[int, int]], ...]
) -> tuple[str, str]:
    return _TOLD[kind]({name: folder / name for name, _ in stamps})


def _diagnosis(files: dict[str, Path]) -> tuple[str, str]:
    report = _json(files.get("report.json"))
    said = str(report.get("headline") or report.get("verdict") or "")
    if later := _headline(files, "judge.json")[0]:  # into the folder of the answer
        said = f"{said} Judged: {later}"
    return said, "finished" if "inputs.json" in files and report else "going on, or interrupted"


def _headline(files: dict[str, Path], name: str) -> tuple[str, str]:
    return str(_json(files.get(name)).get("headline") or ""), "finished"


def _training(files: dict[str, Path]) -> tuple[str, str]:
    last = _last_row(files["results.jsonl"])
    if not last:
        return "", "started"
    reward = next((last[k] for k in ("reward", "return", "mean_return") if k in last), None)
    said = f"reward {reward:.4g}" if isinstance(reward, float) else ""
    if last.get("finished"):
        return said, "finished"
    steps = last.get("steps")
    done = f"{steps:.10g}" if isinstance(steps, float) else _count_rows(files["results.jsonl"])
    return said, f"{done} steps so far"


def _device(files: dict[str, Path]) -> tuple[str, str]:
    result = _json(files.get("result.json"))
    if not result:
        table = files.get("progress.jsonl")
        return "", f"{_count_rows(table) if table else 0} evaluations so far"
    loss = result.get("loss")
    return (f"loss {loss:.4g}" if isinstance(loss, float) else ""), "finished"


def _flight(files: dict[str, Path]) -> tuple[str, str]:
    progress = "finished" if "flight.yaml" in files else "going on, or interrupted"
    table = files.get("flight.csv")
    lines = [] if table is None else _tail(table)
    flown = lines[-1].partition(b",")[0] if lines else b""
    try:
        return f"{float(flown):.3g} s flown", progress
    except ValueError:  # the header alone, or not even that
        return "nothing flown", "no flight"


def _describe_finished(files: dict[str, Path]) -> tuple[str, str]:
    return "", "finished"


# The file that tells the kind, the first that is there.
_KINDS = {
    "report.json": "diagnosis",
    "inputs.json": "diagnosis",
    "judge.json": "judgment",
    "faults.json": "faults",
    "results.jsonl": "training",
    "progress.jsonl": "device",
    "flight.csv": "flight",
    "results.json": "demo",
    "plan.yaml": "fabrication",
}
_TOLD: dict[str, Callable[[dict[str, Path]], tuple[str, str]]] = {
    "diagnosis": _diagnosis,
    "judgment": partial(_headline, name="judge.json"),
    "faults": partial(_headline, name="faults.json"),
    "training": _training,
    "device": _device,
    "flight": _flight,
    "demo": _describe_finished,
    "fabrication": _describe_finished,
    "site": _describe_finished,
}


def _json(path: Path | None) -> Mapping[str, Any]:
    """Content of a file, of a long one what its head holds; nothing where it is missing or cut."""
    if path is None:
        return {}
    with path.open("rb") as file:
        head = file.read(_HEAD)
        return _head_of(head.decode("utf-8", "replace")) if file.read(1) else _mapping(head)


def _head_of(text: str) -> Mapping[str, Any]:
    """The first values of a JSON object, those that are whole.

    Lists of 99 MB took 17 CPU s and 2.6 GB for one sentence.
    """
    decoder, found = json.JSONDecoder(parse_int=float), {}
    at = text.find("{") + 1
    try:
        while at > 0:
            key, at = decoder.raw_decode(text, _skip(text, at))
            found[str(key)], at = decoder.raw_decode(text, _skip(text, _skip(text, at) + 1))
            at = _skip(text, at) + 1  # the comma
    except (ValueError, RecursionError):
        pass  # the value that is cut
    return found


def _skip(text: str, at: int) -> int:
    """Place of the next letter that is no blank."""
    while text[at : at + 1] in (" ", "\n", "\r", "\t"):
        at += 1
    return at


def _mapping(text: bytes) -> Mapping[str, Any]:
    """A JSON object, its numbers as floats; nothing where it is none."""
    try:
        # an integer of 400 digits is none that can be shown
        content = json.loads(text.decode("utf-8", "replace"), parse_int=float)
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _last_row(path: Path) -> Mapping[str, Any]:
    """The last whole row of a table of progress, found from its end."""
    return next((row for line in reversed(_tail(path)) if (row := _mapping(line))), {})


def _tail(path: Path) -> list[bytes]:
    """The last lines of a file; the first of them may be cut."""
    with path.open("rb") as file:
        file.seek(-min(_TAIL, file.seek(0, os.SEEK_END)), os.SEEK_END)
        return file.read().splitlines()


def _count_rows(path: Path) -> str:
    """How many rows a table of progress has, as far as it is read."""
    with path.open("rb") as file:
        count = file.read(_MOST_BYTES).count(b"\n")
        return f"more than {count}" if file.read(1) else str(count)
