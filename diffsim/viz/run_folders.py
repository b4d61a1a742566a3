"""Folders of runs: what each is, how far it is, which pages, pictures and recordings it has.

Files are recognized by the names that the commands give them; nothing is computed or changed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

PAGES, PICTURES, RECORDINGS = (".html",), (".png", ".svg", ".gif"), (".rrd",)
_MOST_BYTES = 50_000_000  # of a table of progress that is read


@dataclass(frozen=True)
class RunFolder:
    """One run.

    Attributes:
        path: Folder, relative to the folder of all runs.
        kind: Such as "diagnosis"; "files" where it is not recognized.
        said: Result of the run, in one line.
        progress: How far it is: "finished", or what is done so far.
        changed: Time of the last change [s since 1970].
        files: All files in it that a browser or a viewer shows, by name.
    """

    path: str
    kind: str
    said: str
    progress: str
    changed: float
    files: tuple[str, ...]

    def of_kind(self, endings: tuple[str, ...]) -> list[str]:
        """Files with one of the endings."""
        return [name for name in self.files if name.lower().endswith(endings)]


def run_folders(root: Path) -> list[RunFolder]:
    """All runs below a folder, the latest first.

    Args:
        root: Folder of all runs.
    """
    folders = [root, *sorted(p for p in root.rglob("*") if p.is_dir() and not p.is_symlink())]
    hidden = [f for f in folders if any(part[:1] == "." for part in f.relative_to(root).parts)]
    sites = {f for f in folders if _is_site(f)}
    hidden += [f for f in folders if sites.intersection(f.parents)]
    made = (_run_folder(root, folder) for folder in folders if folder not in hidden)
    return sorted((m for m in made if m is not None), key=lambda run: -run.changed)


def _is_site(folder: Path) -> bool:
    """Whether it holds a built site, such as that of the documentation: one page leads to all."""
    return all((folder / name).is_file() for name in ("index.html", "404.html"))


def _run_folder(root: Path, folder: Path) -> RunFolder | None:
    files = {p.name: p for p in sorted(folder.iterdir()) if p.is_file() and p.name[:1] != "."}
    shown = tuple(n for n in files if n.lower().endswith((*PAGES, *PICTURES, *RECORDINGS)))
    kind = next((kind for marker, kind in _KINDS.items() if marker in files), None)
    if kind is None and _is_site(folder):
        shown, kind = ("index.html",), "site"
    if kind is None and not shown:
        return None
    said, progress = "", "finished"
    if kind is not None:
        said, progress = _TOLD[kind](files)
    changed = max(p.stat().st_mtime for p in files.values())
    relative = folder.relative_to(root).as_posix()
    return RunFolder(relative, kind or "files", said, progress, changed, shown)


def _diagnosis(files: dict[str, Path]) -> tuple[str, str]:
    report = _json(files.get("report.json"))
    said = str(report.get("headline") or report.get("verdict") or "")
    if later := _headline(files, "judge.json")[0]:  # into the folder of the answer
        said = f"{said} Judged: {later}"
    return said, "finished" if "inputs.json" in files and report else "going on, or interrupted"


def _headline(files: dict[str, Path], name: str) -> tuple[str, str]:
    return str(_json(files.get(name)).get("headline") or ""), "finished"


def _training(files: dict[str, Path]) -> tuple[str, str]:
    rows = [row for row in _rows(files["results.jsonl"]) if isinstance(row, dict)]
    if not rows:
        return "", "started"
    last = rows[-1]
    reward = next((last[k] for k in ("reward", "return", "mean_return") if k in last), None)
    said = f"reward {reward:.4g}" if isinstance(reward, (int, float)) else ""
    steps = last.get("steps", len(rows))
    return said, "finished" if last.get("finished") else f"{steps} steps so far"


def _device(files: dict[str, Path]) -> tuple[str, str]:
    result = _json(files.get("result.json"))
    count = sum(1 for _ in _rows(files["progress.jsonl"])) if "progress.jsonl" in files else 0
    if not result:
        return "", f"{count} evaluations so far"
    loss = result.get("loss")
    return (f"loss {loss:.4g}" if isinstance(loss, (int, float)) else ""), "finished"


def _flight(files: dict[str, Path]) -> tuple[str, str]:
    return "", "finished" if "flight.yaml" in files else "going on, or interrupted"


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


def _json(path: Path | None) -> dict[str, Any]:
    """Content of a file; nothing where it is missing or being written."""
    try:
        content = json.loads(path.read_text(encoding="utf-8")) if path else {}
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _rows(path: Path) -> Iterator[Any]:
    if path.stat().st_size > _MOST_BYTES:
        return
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            yield json.loads(line)
        except ValueError:  # the last line of a run that goes on
            continue
