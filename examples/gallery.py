"""The gallery: every result with a picture and one number, made by running the examples.

``examples/gallery.yaml`` says which script, with which options, which line of its output holds the
number, and which file is the picture. A result is kept in the output folder and not made again
while the script and its options stay as they were, and the numbers on the documentation's page in
``docs/gallery.json``, so that one entry can be made anew where the others' folders are gone. What
takes hours (training, sets of sealed cases) is not run: its number is read from the page that its
own command fills.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffsim.cli.examples import examples
from diffsim.core import DiffsimError, show_progress
from diffsim.core.check import require_choice
from diffsim.core.files import write_json_atomic, write_text_atomic
from diffsim.core.yaml_text import read_yaml_file

FOLDER = Path(__file__).parent
DOCS = FOLDER.parent / "docs"
RECORD = "gallery.json"  # beside the page: what it shows of scripts
REFINED = "refinement.json"  # the same: what ``python -m benchmarks.refinement`` has made


@dataclass(frozen=True, kw_only=True)
class GalleryEntry:
    """One result of the gallery."""

    title: str  # a line for people
    group: str  # heading that it stands under
    image: str  # name of the picture under docs/images
    pattern: str  # regular expression with one group per number, searched in the output
    number: str  # text with ``{}`` for each group
    example: str = ""  # name of the script; "" where ``page`` is given
    # options of the script; ``{out}`` is replaced by the folder that keeps the result
    options: tuple[str, ...] = ()
    picture: str = ""  # file below that folder
    thesis: str = ""  # what the thesis has, and why ours differs, one line; "" where it has nothing
    page: str = ""  # instead of a script: page below docs/ that has number and picture
    command: str = ""  # instead of a script: what fills that page

    @property
    def key(self) -> str:
        """Name of its folder: that of the picture."""
        return Path(self.image).stem


def entries(path: Path = FOLDER / "gallery.yaml") -> list[GalleryEntry]:
    """What the file lists.

    Raises:
        ValueError: an entry has a field too many or too few, or names an unknown example.
    """
    known = examples()
    found = []
    for raw in read_yaml_file(path):
        try:
            entry = GalleryEntry(
                **{**raw, "options": tuple(str(o) for o in raw.get("options", ()))}
            )
        except TypeError as err:
            raise ValueError(f"{path.name}, entry {raw.get('title', raw)!r}: {err}") from err
        if not (entry.page and entry.command):
            require_choice(f"example of {entry.title!r}", entry.example, tuple(known))
        found.append(entry)
    return found


def make(out: Path, names: Sequence[str] = (), docs: Path | None = None) -> list[dict[str, Any]]:
    """Run what is missing and write ``out/gallery.md``; failures are listed and do not stop it.

    Args:
        out: Folder of the results, one folder each.
        names: Keys of the entries to run; empty: all. The page shows all that there are.
        docs: Copy pictures to ``docs/images`` and the page to ``docs/gallery.md``, which goes on
            showing what it showed of entries that are not in ``out``.

    Returns:
        The results in the order of the file, ``{"key", "number", "seconds", "failure"}``.
    """
    listed = entries()
    for name in names:
        require_choice("name", name, tuple(e.key for e in listed))
    chosen = [e for e in listed if not names or e.key in names]
    with show_progress(chosen, desc="gallery") as bar:
        for entry in bar:
            bar.set_postfix_str(entry.key)
            if entry.example:
                _run_entry(entry, out / entry.key)
    shown = {} if docs is None else _read_results(docs / RECORD)
    made = {e.key: r for e in listed if (r := _read_kept_result(e, out / e.key)) is not None}
    shown = {e.key: (shown | made)[e.key] for e in listed if e.key in shown | made}
    images = Path("images") if docs is not None else None
    page = markdown([e for e in listed if e.key in shown], shown, images)
    write_text_atomic(out / "gallery.md", page)
    if docs is not None:
        for entry in listed:
            if entry.example and entry.key in made and not made[entry.key]["failure"]:
                shutil.copyfile(out / entry.key / entry.picture, docs / "images" / entry.image)
        write_text_atomic(docs / "gallery.md", page)
        scripts = [shown[e.key] for e in listed if e.example and e.key in shown]
        write_json_atomic(docs / RECORD, [r for r in scripts if not r["failure"]])
    return list(shown.values())


def _read_results(path: Path) -> dict[str, dict[str, Any]]:
    if not path.is_file():
        return {}
    return {result["key"]: result for result in json.loads(path.read_text())}


def _fingerprint(entry: GalleryEntry) -> str:
    text = examples()[entry.example].path.read_text(encoding="utf-8")
    return hashlib.sha256(f"{entry.options}{text}".encode()).hexdigest()


def _read_kept_result(entry: GalleryEntry, folder: Path) -> dict[str, Any] | None:
    """The result on file; its number is read anew, so that a changed pattern needs no new run."""
    if entry.page:
        return _from_page(entry)
    path = folder / "result.json"
    if not path.is_file():
        return None
    result = json.loads(path.read_text())
    if result["failure"]:
        return result
    match = re.search(entry.pattern, (folder / "output.txt").read_text(encoding="utf-8"))
    if match is None:
        result["failure"] = f"its output has no line like {entry.pattern!r}"
    elif not (folder / entry.picture).is_file():
        result["failure"] = f"it left no {entry.picture}"
    else:
        result["number"] = entry.number.format(*(_shorten_numbers(g) for g in match.groups()))
    return result


def _from_page(entry: GalleryEntry) -> dict[str, Any]:
    match = re.search(entry.pattern, (DOCS / entry.page).read_text(encoding="utf-8"))
    if match is None:
        failure = f"docs/{entry.page} has no line like {entry.pattern!r}"
        return {"key": entry.key, "seconds": 0.0, "failure": failure}
    number = entry.number.format(*match.groups())
    return {"key": entry.key, "seconds": 0.0, "failure": "", "number": number}


def _run_entry(entry: GalleryEntry, folder: Path) -> None:
    mark = _fingerprint(entry)
    kept = _read_kept_result(entry, folder)
    if kept is not None and kept["fingerprint"] == mark and not kept["failure"]:
        return
    folder.mkdir(parents=True, exist_ok=True)
    script = examples()[entry.example].path
    options = [o.replace("{out}", str(folder.absolute())) for o in entry.options]
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(script), *options],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "Agg"},
        check=False,
    )
    write_text_atomic(folder / "output.txt", done.stdout)
    failure = ""
    if done.returncode:
        failure = " ".join(done.stderr.split())[-300:] or f"exit status {done.returncode}"
    write_json_atomic(
        folder / "result.json",
        {
            "key": entry.key,
            "fingerprint": mark,
            "seconds": time.perf_counter() - begin,
            "failure": failure,
        },
    )


def _shorten_numbers(text: str) -> str:
    """Numbers with at most three digits, other text as it is."""
    try:
        return f"{float(text.replace(',', '')):.3g}"
    except ValueError:
        return text


def markdown(
    shown: Sequence[GalleryEntry], results: dict[str, dict[str, Any]], images: Path | None
) -> str:
    """The page: by group, a picture with its number, the thesis's, and the command."""
    lines = [
        "# Gallery",
        "",
        "Made by `diffsim examples gallery --docs docs` from `examples/gallery.yaml`; the numbers "
        "are read from what the scripts print.",
    ]
    group = ""
    for entry in shown:
        result = results[entry.key]
        if entry.group != group:
            group = entry.group
            lines += ["", f"## {group}"]
        lines += ["", f"### {entry.title}", ""]
        if result["failure"]:
            lines += [f"failed: {result['failure']}"]
            continue
        place = f"{images}/{entry.image}" if images else _place(entry)
        lines += [f"![{entry.title}]({place})", "", f"**{result['number']}**"]
        if entry.thesis:
            lines += ["", f"Thesis: {entry.thesis}"]
        lines += ["", f"`{_command(entry)}`"]
    return "\n".join([*lines, *_under_refinement(DOCS / REFINED)]) + "\n"


def _under_refinement(path: Path) -> list[str]:
    """The table of results whose time step and mesh were refined; nothing without a record."""
    if not path.is_file():
        return []
    record = json.loads(path.read_text(encoding="utf-8"))
    changes = list(dict.fromkeys(c for row in record.values() for c in row["values"]))
    lines = [
        "",
        "## Under refinement",
        "",
        "Same commands, solved again with smaller time steps and on finer meshes (half the edge, a "
        "third for the swimmer), by `python -m benchmarks.refinement`. What they mean: "
        "[applications](applications.md#how-far-to-trust-them).",
        "",
        f"| result | number | {' | '.join(changes)} |",
        f"|---|---|{'---|' * len(changes)}",
    ]
    for name, row in record.items():
        made = row["values"]
        cells = [f"{made[c]:.3g}" if c in made else "not run" for c in changes]
        lines.append(f"| {name} | {row['quantity']} | {' | '.join(cells)} |")
    return lines


def _place(entry: GalleryEntry) -> str:
    if entry.page:
        return str(DOCS / "images" / entry.image)
    return f"{entry.key}/{entry.picture}"


def _command(entry: GalleryEntry) -> str:
    if entry.command:
        return entry.command
    options = " ".join(entry.options).replace("{out}", f"runs/{entry.key}")
    return f"diffsim examples run {entry.example}{' -- ' + options if options else ''}"


def require_success(results: Sequence[dict[str, Any]]) -> None:
    """Raise DiffsimError that names what failed."""
    failed = [f"{r['key']}: {r['failure']}" for r in results if r["failure"]]
    if failed:
        raise DiffsimError("; ".join(failed))
