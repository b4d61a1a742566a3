"""Files beside recordings that hold no samples: what they state, and what is passed by."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from diffsim.core.figures import list_first
from diffsim.core.units import in_si
from diffsim.core.yaml_text import load_yaml
from diffsim.data.folder_tables import BAG, files_below
from diffsim.data.guess import Guess, GuessedRun, listed
from diffsim.data.table_guess import column_of

SHEETS = (".json", ".yaml", ".yml")
MAX_SHEET_BYTES = 100_000  # of a file of facts
MOST_LETTERS = 60  # of a fact; longer ones are remarks
MOST_SHOWN = 12  # facts of a file that a sentence states
_META = "meta"  # folder of a LeRobot dataset, whose sheets describe its tables
_OF_STUDY = ("channels", "runs", "like")  # keys of a study, which is no file of facts
_NUMBER = re.compile(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?")  # that a quantity begins with
#: Recordings of formats that only their own programs read.
_UNREAD = (".c3d", ".xls", ".tdms", ".mf4", ".mdf", ".blf", ".slx", ".fig")
_OF_MODELS = (".xml", ".stl", ".obj", ".msh", ".dae")
_NO_DATA = (".md", ".rst", ".py", ".m", ".ipynb", ".pdf", ".png", ".jpg", ".svg", ".html")


def facts_beside(guess: Guess) -> Iterable[str]:
    """Sheets of numbers and words: those of one run are its facts, others may be the model's."""
    taken = {guess.folder / file.partition("#")[0] for run in guess.runs for file in run.files}
    left = [path for path in sorted(files_below(guess.folder)) if path not in taken]
    tables = {one.path for one in guess.found}
    leaves = {path: _leaves_of(path) for path in left if path not in tables}
    sheets = {path: facts for path, own in leaves.items() if (facts := _facts_among(own))}
    of_runs: set[Path] = set()
    replaced = []
    for path, facts in sheets.items():
        for run in _runs_of(path, guess):
            of_runs.add(path)
            for name, fact in map(_as_fact, facts, facts.values()):
                if not name:
                    continue
                if run.setup.get(name, fact) != fact:
                    replaced.append(f"{name} of {run.name} by {path.name}")
                run.setup[name] = fact
    yield from listed("facts that are stated twice and differ, the last one is taken", replaced)
    names = [path.relative_to(guess.folder).as_posix() for path in of_runs]
    yield from listed("facts of single runs, taken from", sorted(names))
    for path, facts in sheets.items():
        if path not in of_runs:
            said = list_first([f"{name} {value}" for name, value in facts.items()], MOST_SHOWN)
            guess.todo.append(
                f"numbers of the model: {path.relative_to(guess.folder).as_posix()} states {said}"
            )
            yield f"facts, not yet used: {path.relative_to(guess.folder).as_posix()} ({said})"
    remarks = [
        f"{name} of {path.name}"
        for path in sheets
        for name, value in leaves[path].items()
        if isinstance(value, str) and len(value.strip()) > MOST_LETTERS
    ]
    yield from listed(f"texts and lists of more than {MOST_LETTERS} letters, no facts", remarks)
    guess.beside = [path for path in left if path not in sheets]


def passed_by(guess: Guess, *, has_model: bool) -> Iterator[str]:
    """Sentences on files that no other sentence names.

    Args:
        guess: What the folder seems to hold, once all of it is said.
        has_model: Whether an MJCF of the folder was read; what it is made of is used.
    """
    known = {one.path for one in guess.found}
    said = " ".join(guess.said).replace(f"{guess.folder}/", "")
    rest = {
        path.relative_to(guess.folder).as_posix(): path.suffix.lower()
        for path in guess.beside
        if path not in known and path.name[0] not in "._" and not _is_study(_content_of(path))
    }
    rest = {name: ending for name, ending in rest.items() if not _is_named(name, said)}
    unread = [name for name, ending in rest.items() if ending in _UNREAD]
    for sentence in listed("recordings in formats that are not read", unread, 3):
        yield f"{sentence}; export them as CSV"
    used = (*_UNREAD, *_NO_DATA, *(_OF_MODELS if has_model else ()))
    others = [name for name, end in rest.items() if end not in used]
    yield from listed("other files, not used", others, 6)


def _is_named(name: str, said: str) -> bool:
    """Whether sentences name a file, rather than one whose name ends or begins like its own."""
    return re.search(rf"(?<![\w./-]){re.escape(name)}(?![\w-]|\.\w)", said) is not None


def facts_of(path: Path) -> dict[str, Any]:
    """Numbers and words of a sheet by name, with those of blocks in it; empty where it is none.

    Args:
        path: Any file.
    """
    return _facts_among(_leaves_of(path))


def _leaves_of(path: Path) -> dict[str, Any]:
    """Numbers, words and lists of a sheet, with those of blocks in it; none of a study."""
    is_known = path.name == BAG or path.parent.name == _META
    content = {} if is_known else _content_of(path)
    return {} if _is_study(content) else dict(_flat("", content, 3))


def _facts_among(leaves: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in leaves.items() if not _says_nothing(value)}


def _content_of(path: Path) -> Mapping[Any, Any]:
    """What a sheet states; empty where it is none."""
    if path.suffix.lower() not in SHEETS or path.stat().st_size > MAX_SHEET_BYTES:
        return {}
    try:
        text = path.read_text("utf-8-sig")
        content = json.loads(text) if path.suffix.lower() == ".json" else load_yaml(text, path)
    except (ValueError, RecursionError, yaml.YAMLError):
        return {}
    return content if isinstance(content, Mapping) else {}


def _is_study(content: Mapping[Any, Any]) -> bool:
    return any(key in content for key in _OF_STUDY)


def _flat(start: str, content: Mapping[Any, Any], depth: int) -> Iterator[tuple[str, Any]]:
    for key, value in content.items():
        name = f"{start}{key}"
        if isinstance(value, Mapping) and depth:
            yield from _flat(f"{name}.", value, depth - 1)
        elif isinstance(value, str | int | float | list):
            is_label = isinstance(value, bool | list)
            yield name, str(value).lower() if is_label else value


def _says_nothing(value: str | float) -> bool:
    """Whether a number is none, or a text or list is empty or too long for a fact."""
    if isinstance(value, float):
        return not math.isfinite(value)
    return not 0 < len(str(value).strip("[] ")) <= MOST_LETTERS


def _runs_of(path: Path, guess: Guess) -> list[GuessedRun]:
    """The runs that a sheet belongs to: those of its name, or the only one of its folder."""
    if guess.split:
        return []
    own = [
        run
        for run in guess.runs
        if any((guess.folder / file.partition("#")[0]).with_suffix("") == path.with_suffix("")
               for file in run.files)
    ]  # fmt: skip
    if own or path.parent == guess.folder:
        return own
    beside = [run for run in guess.runs if (guess.folder / run.files[0]).parent == path.parent]
    return beside if len(beside) == 1 < len(guess.runs) else []


def _as_fact(name: str, value: Any) -> tuple[str, Any]:
    """Name and value as ``setup`` of a run has them; an empty name where nothing is said."""
    column = column_of(name)
    if isinstance(value, str):
        number = _NUMBER.match(value.strip())
        try:
            in_si(value)
        except ValueError:
            number = None
        if number is None:
            return column.base, value
        unit = value.strip()[number.end() :].strip()
        return column.base, {"value": float(number[0]), "unit": unit} if unit else float(number[0])
    stated = {"value": value, "unit": column.unit} if column.unit else value
    return column.base, stated
