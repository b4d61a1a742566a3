"""Studies read from ``study.yaml`` and CSV files; every mistake is told at once, with its place.

The least that a study needs; all keys are in docs/study_keys.md::

    name: cart
    model: {system: ode, ...}                    # see the system's own page; or like: RIG
    time: {column: "t (ms)", unit: ms}           # default: column time_s
    channels:                                    # what was measured; inside all is in SI units
      - {name: position, column: "pos (mm)", unit: mm, sd: 0.1}
      - {name: middle, formula: "0.5*(left + `right 2`)", unit: mm}
    commands:                                    # what was commanded; may be empty
      - {name: force, column: F, unit: N, lower: -5, upper: 5, rate: 100}
    runs:
      - {name: a, file: a.csv, use: fit, setup: {payload_kg: 0.2, frame: A}, until_s: 5}
      - {name: b, file: b.csv, repeat_of: a, every: 10}
      - {name: "toss_{toss}", file: tosses.csv, split: toss, use: {test: [7, 9], select: [3]}}
      - {file: "step_{level}mbar.csv", setup: {pressure: {value: "{level}", unit: mbar}}}
      - {file: long.csv, blocks: {num: 6, use: {select: [4], test: [6]}}}

CSV files have a header line; an empty cell is a missing value; comma, semicolon, tab or blanks
divide cells, and where it is not the comma, a decimal comma is read.

A study may be like another one, or like a rig that is ready: ``like:``. What the study states goes
before. Mappings are joined key by key; entries of lists that have names are joined by them, others,
and ``runs``, are put in their place as a whole. ``null`` takes a key away.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.core.check import did_you_mean
from diffsim.core.checked import checked
from diffsim.core.errors import Mistakes
from diffsim.core.figures import fold_alike, list_first
from diffsim.core.inside import inside
from diffsim.core.paths import data_candidates
from diffsim.core.schema import read_part
from diffsim.core.units import to_si
from diffsim.core.yaml_text import read_yaml_file
from diffsim.data.formats import split_part
from diffsim.data.run_files import RunReader
from diffsim.data.study import Channel, Command, Study
from diffsim.data.study_schema import ChannelEntry, CommandEntry, StudyFile

STUDY_FILE = "study.yaml"
MAX_LINES = 20  # of problems; more of them say no more
_TABLES = ("*.csv", "*.tsv", "*.txt", "*.dat", "*.log", "*.asc")
_KINDS = {
    "m": "position",
    "rad": "angle",
    "m/s": "velocity",
    "rad/s": "angular_velocity",
    "m/s^2": "acceleration",
    "N": "force",
    "N m": "torque",
    "Pa": "pressure",
    "m^3/s": "flow",
    "V": "voltage",
    "A": "current",
    "px": "image",
    "K": "temperature",
}


@checked
def load_study(
    path: str | Path, more_runs: Sequence[Mapping[str, Any]] = (), *, strict: bool = True
) -> Study:
    """Read a study from ``study.yaml`` and its CSV files.

    Args:
        path: ``study.yaml`` (any YAML file), or the folder that holds it.
        more_runs: Further entries of ``runs:``, as the file would hold them; theirs may name files
            anywhere, the study's own only those in its folder.
        strict: Whether stamps that are missing, equal or go back are refused; else their rows are
            left out, and ``check_study`` has an error for them.

    Returns:
        The study in SI units; what it lacks for a diagnosis says
        :func:`diffsim.data.check_study`, what of its folder it does not use ``left_out``.

    Raises:
        FileNotFoundError: the study, or the published data set that it names, is not there.
        ValueError: something cannot be read; the message has a line for each mistake, with the
            key, or with file, row and column.
    """
    path = Path(path)
    path = path / STUDY_FILE if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such study; give study.yaml or the folder that has it")
    content = read_whole(path)
    if more_runs and isinstance(content, Mapping):
        content = {**content, "runs": [*content.get("runs", ()), *more_runs]}
    stated = _parse_study(path, content)
    root = _root(path, stated)
    given = [Path(run["file"]) for run in more_runs if "file" in run]
    reader = RunReader(stated, root, given, strict=strict)
    try:
        runs = reader.runs()
    except MemoryError as error:
        raise ValueError(f"{path}: its files need more memory than there is") from error
    if reader.problems:
        raise Mistakes(_prefix_path(path, reader.problems), MAX_LINES)
    try:
        return Study(
            name=stated.name,
            system=str((stated.model or {}).get("system") or stated.system),
            channels=tuple(_channel(c) for c in stated.channels),
            runs=runs,
            metadata=stated.metadata,
            model=stated.model,
            folder=root if stated.model_folder is None else path.parent / stated.model_folder,
            commands=tuple(_command(c) for c in stated.commands),
            file=path,
            left_out=_left_out(reader, stated, root),
            todo=stated.todo,
            allows=stated.allows,
            export=stated.export,
            faults=stated.faults,
            columns=reader.columns,
            mended=tuple(
                f"{said} ({list_first([f'run {name}' for name in names])})"
                for said, names in reader.mended.items()
            ),
            stamps=tuple(reader.stamps),
        )
    except ValueError as error:  # names that stand twice
        raise ValueError(f"{path}: {error}") from error


def _parse_study(path: Path, content: Any) -> StudyFile:
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: the study must be a mapping, got {type(content).__name__}")
    stated = read_part(StudyFile, content, f"{path}: ")
    if stated.model is None and stated.system is None:
        raise ValueError(
            f"{path}: the study has neither model nor system; describe its model, or say "
            "what it is like"
        )
    if stated.model is not None and "system" not in stated.model:
        raise ValueError(f"{path}: model has no system; name the kind of system")
    return stated


def _root(path: Path, stated: StudyFile) -> Path:
    """Folder of the files: beside the study, a path from there, or a published data set."""
    if stated.data is None:
        return path.parent
    beside = path.parent / stated.data
    if beside.is_dir():
        return beside
    try:
        found = find_dataset(stated.data)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path}: data: {error}") from None
    if found is None:
        raise FileNotFoundError(
            f"{path}: data: no folder {stated.data} beside the study, and no published data set "
            "of that name is on this machine; `diffsim data get "
            f"{stated.data}` says from where, or set DIFFSIM_DATA to the folder that holds it"
        )
    return found


def _prefix_path(path: Path, problems: list[str]) -> list[str]:
    """Problems, a line each; those of an entry begin with the study's path."""
    return [p if p.startswith(("/", str(path.parent))) else f"{path}: {p}" for p in problems]


def _channel(entry: ChannelEntry) -> Channel:
    si = to_si(entry.unit)
    shown = _choose_shown_unit(entry)
    kind = entry.kind or _KINDS.get(si.unit, "quantity")
    sd = None if entry.sd is None else si.factor * entry.sd
    ends = (None if v is None else si.factor * v + si.offset for v in (entry.lower, entry.upper))
    return Channel(entry.name, si.unit, kind, sd, shown, entry.sensor, entry.shown_formula, *ends)


def _choose_shown_unit(entry: ChannelEntry | CommandEntry) -> str | None:
    """Unit in which a user reads it; kelvins for degrees Celsius, whose zero no factor moves."""
    assert entry.unit is not None
    shown = entry.shown_unit or entry.unit
    return shown if shown != to_si(entry.unit).unit and not to_si(shown).offset else None


def _command(entry: CommandEntry) -> Command:
    if entry.unit is None:
        own = (entry.lower, entry.upper, entry.rate, entry.is_measured)
        return Command(entry.name, None, *own, before=entry.before)
    si = to_si(entry.unit)
    shown = _choose_shown_unit(entry)
    lower, upper, before = (
        None if v is None else si.factor * v + si.offset
        for v in (entry.lower, entry.upper, entry.before)
    )
    rate = None if entry.rate is None else si.factor * entry.rate
    return Command(entry.name, si.unit, lower, upper, rate, entry.is_measured, shown, before)


def _left_out(reader: RunReader, stated: StudyFile, root: Path) -> tuple[str, ...]:
    """Files and columns that no run holds, and what the reader left out."""
    used = {split_part(path)[0] for path in reader.tables}
    folders = {path.parent for path in used} | {root}
    mentioned = str(stated.model)
    files = sorted(
        path.name
        for folder in folders
        for pattern in _TABLES
        for path in folder.glob(pattern)
        if path not in used and path.name not in mentioned
    )
    out = [f"files: {list_first(files)}"] if files else []
    beside = {column.header for column in reader.columns}
    unused = Counter(
        name
        for table in reader.tables.values()
        for name in table.header
        if name and name not in table.used and name not in beside
    )
    if unused:
        out.append(f"columns: {list_first([_in_files(n, k) for n, k in unused.items()])}")
    return (*out, *fold_alike(reader.left_out))


def _in_files(name: str, count: int) -> str:
    return name if count == 1 else f"{name} ({count} files)"


READY = Path(__file__).parent / "ready"  # rigs by the names of their files


def ready_rigs() -> tuple[str, ...]:
    """Names of the rigs that are ready."""
    return tuple(sorted(file.stem for file in READY.glob("*.yaml")))


def read_whole(path: Path) -> Any:
    """Content of a study file, joined with that of the one it is like.

    Returns:
        What the file holds, without ``like``; whatever it is, where it is no mapping.

    Raises:
        FileNotFoundError: neither a file nor a rig of the name in ``like``.
        ValueError: a file that is like itself, or that is not in the study's folder.
    """
    return _read(path, ())


def _read(path: Path, seen: tuple[Path, ...]) -> Any:
    if path.resolve() in seen:
        raise ValueError(f"{path}: like: leads back to {path.name}")
    content = read_yaml_file(path)
    if not isinstance(content, Mapping) or "like" not in content:
        return content
    own = {key: value for key, value in content.items() if key != "like"}
    base = _read(_find(path, str(content["like"])), (*seen, path.resolve()))
    if "runs" in own and isinstance(base, Mapping):  # recordings are a study's own
        base = {key: value for key, value in base.items() if key != "runs"}
    return joined(base, own)


def _find(path: Path, name: str) -> Path:
    """The file that a name means: one in the study's folder, or a rig that is ready."""
    if (file := inside(path.parent, name, f"{path}: like")).is_file():
        return file
    if name in ready_rigs():
        return READY / f"{name}.yaml"
    raise FileNotFoundError(
        f"{path}: like: no file {name} beside the study, and no rig of that name is ready "
        f"(ready: {', '.join(ready_rigs())}){did_you_mean(name, ready_rigs())}"
    )


def joined(base: Any, own: Any) -> Any:
    """Two contents, of which ``own`` goes before.

    Args:
        base: What holds where ``own`` states nothing.
    """
    if isinstance(base, Mapping) and isinstance(own, Mapping):
        merged = dict(base)
        for key, value in own.items():
            if value is None:
                merged.pop(key, None)
            else:
                merged[key] = joined(base[key], value) if key in base else value
        return merged
    if _has_names(base) and _has_names(own):
        rows = {entry["name"]: entry for entry in base}
        for entry in own:
            rows[entry["name"]] = joined(rows.get(entry["name"], {}), entry)
        return list(rows.values())
    return own


def _has_names(given: Any) -> bool:
    """Whether it is a list whose entries all have a name."""
    return (
        isinstance(given, Sequence)
        and not isinstance(given, str)
        and all(isinstance(entry, Mapping) and "name" in entry for entry in given)
    )


@checked
def find_dataset(name: str, data: str | Path | None = None) -> Path | None:
    """Folder of a data set: under ``data``, else DIFFSIM_DATA, else the folders of ``_paths``.

    Args:
        name: Folder name, such as ``silicone_beam``.
        data: Folder that holds the data sets (or the data set's own folder). When given, or when
            DIFFSIM_DATA is set, nothing else is searched: a typing error must not silently lead
            to other data.

    Returns:
        The folder, or None if none was asked for and none was found.

    Raises:
        FileNotFoundError: ``data`` or DIFFSIM_DATA was given but does not hold the set.
    """
    asked = [("data", data)] if data is not None else []
    if not asked and (from_env := os.environ.get("DIFFSIM_DATA")):
        asked = [("DIFFSIM_DATA", from_env)]
    for label, value in asked:
        base = Path(str(value)).expanduser()
        for folder in (base / name, base):
            if (folder / "metadata.yaml").is_file() and (folder is not base or base.name == name):
                return folder
        has = sorted(p.name for p in base.iterdir() if p.is_dir()) if base.is_dir() else None
        state = "does not exist" if has is None else f"holds {', '.join(has) or 'no folders'}"
        raise FileNotFoundError(
            f"{label}={base} must be the folder that holds {name}/metadata.yaml; it {state}"
            f"{did_you_mean(name, has or [])}"
        )
    folders = (base / name for base in data_candidates())
    return next((folder for folder in folders if (folder / "metadata.yaml").is_file()), None)
