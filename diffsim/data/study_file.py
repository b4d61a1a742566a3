"""Studies as files: ``study.yaml`` and one tidy CSV per run.

CSV: ``time_s`` first, then the channels, then the commands; units are in the column names
(``tip_z_m``, ``pressure_Pa``, ``flow_m3_s``; none where dimensionless); an empty cell is a missing
value. ``study.yaml``::

    name: beam_in_air
    system: soft_body            # soft_body, copter, stokes or rigid_body
    channels:                    # columns that were measured
      - {name: tip_z_m, unit: m, kind: position, sd: 3.0e-6}    # sd: optional, in unit
    commands: [tendon_N]         # columns that were commanded; may be empty
    runs:
      - name: step_a
        file: step_a.csv         # beside study.yaml
        group: step              # runs of one group executed the same command
        order: 0                 # place in the sequence of experiments; default: place here
        use: fit                 # fit (default), select or test
        setup: {temperature_C: 22.5}     # optional facts of this run, numbers
    metadata: {}                 # optional: geometry, settings, source, licence
"""

from __future__ import annotations

import math
import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffsim.core.check import did_you_mean, require_choice
from diffsim.core.files import to_plain, write_text_atomic
from diffsim.data.study import SYSTEMS, USES, Channel, Run, Study
from diffsim.data.table import open_table, parse_number, parse_time, time_column

STUDY_FILE = "study.yaml"

_FILE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
_STUDY_KEYS = ("name", "system", "model", "channels", "commands", "runs", "metadata")
_CHANNEL_KEYS = ("name", "unit", "kind", "sd")
_RUN_KEYS = ("name", "file", "group", "order", "use", "setup")


def unit_suffix(unit: str) -> str:
    """Ending of the name of a column with this unit: "m/s" -> "_m_s", "N m" -> "_Nm", "-" -> ""."""
    return "" if unit == "-" else "_" + unit.replace(" ", "").replace("/", "_")


def load_study(path: str | Path) -> Study:
    """Read a study from ``study.yaml`` and its CSV files.

    Args:
        path: ``study.yaml``, or the folder that holds it.

    Returns:
        The study; what it lacks for a diagnosis says :func:`diffsim.data.check_study`.

    Raises:
        FileNotFoundError: the study or one of its runs is not there.
        ValueError: something cannot be read; the message names file, row and column, or the entry.
    """
    path = Path(path)
    path = path / STUDY_FILE if path.is_dir() else path
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such study; give study.yaml or the folder that has it")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: not YAML: {error}") from None
    study = _mapping(path, "the study", content, _STUDY_KEYS, ("name", "channels", "runs"))
    channels = tuple(_channel(path, i, c) for i, c in enumerate(_list(path, "channels", study)))
    commands = [str(c) for c in _list(path, "commands", study)]
    runs = tuple(
        _run(path, i, entry, channels, commands)
        for i, entry in enumerate(_list(path, "runs", study))
    )
    return Study(
        name=str(study["name"]),
        system=_system(path, study),
        channels=channels,
        runs=runs,
        metadata=study.get("metadata") or {},
        model=study.get("model"),
        folder=path.parent,
    )


def save_study(study: Study, folder: str | Path, *, overwrite: bool = False) -> Path:
    """Write ``study.yaml`` and its runs; the folder is there whole or not at all.

    Numbers are written so that they are read back unchanged.

    Args:
        study: Study to be written.
        folder: Made; must be empty or absent unless ``overwrite``.
        overwrite: Replace a folder that holds a study, with all that is in it.

    Returns:
        Path of ``study.yaml``.

    Raises:
        FileExistsError: the folder has content that may not be replaced.
        ValueError: a run's name cannot be a file name.
    """
    folder = Path(folder)
    for run in study.runs:
        if not _FILE_NAME.fullmatch(run.name):
            raise ValueError(
                f"run name {run.name!r} cannot be a file name; use letters, digits, _ - and ."
            )
    if folder.exists() and any(folder.iterdir()):
        if not (folder / STUDY_FILE).is_file():
            raise FileExistsError(
                f"{folder} is not empty and holds no study; choose another folder"
            )
        if not overwrite:
            raise FileExistsError(f"{folder} already holds a study; replace it with overwrite=True")
    commands = list(dict.fromkeys(name for run in study.runs for name in run.command))
    folder.parent.mkdir(parents=True, exist_ok=True)
    new = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}.", suffix=".tmp"))
    try:
        for run in study.runs:
            write_text_atomic(new / f"{run.name}.csv", _format_run(run, study.channels, commands))
        text = yaml.safe_dump(_to_yaml(study, commands), sort_keys=False, allow_unicode=True)
        write_text_atomic(new / STUDY_FILE, text)
        new.chmod(0o755)  # mkdtemp makes folders that only their owner can enter
        _put_in_place(new, folder)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    return folder / STUDY_FILE


def _put_in_place(new: Path, folder: Path) -> None:
    """Rename ``new`` to ``folder``; an old one stays beside it until the new one is there."""
    if not folder.exists():
        os.replace(new, folder)
        return
    old = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}.", suffix=".old"))
    os.replace(folder, old)
    try:
        os.replace(new, folder)
    except OSError:
        os.replace(old, folder)
        raise
    shutil.rmtree(old)


def _to_yaml(study: Study, commands: list[str]) -> dict[str, Any]:
    return {
        "name": study.name,
        "system": study.system,
        "channels": [
            {"name": c.name, "unit": c.unit, "kind": c.kind}
            | ({} if c.sd is None else {"sd": float(c.sd)})
            for c in study.channels
        ],
        "commands": commands,
        "runs": [
            {"name": r.name, "file": f"{r.name}.csv", "group": r.group, "order": r.order}
            | {"use": r.use, "setup": {k: float(v) for k, v in r.setup.items()}}
            for r in study.runs
        ],
        "metadata": to_plain(dict(study.metadata)),
    }


def _format_run(run: Run, channels: tuple[Channel, ...], commands: list[str]) -> str:
    missing = np.full(len(run.time_s), np.nan)
    columns = [run.time_s, *run.measured.T, *(run.command.get(c, missing) for c in commands)]
    lines = [",".join(["time_s", *(c.name for c in channels), *commands])]
    for row in zip(*columns, strict=True):
        lines.append(",".join("" if math.isnan(v) else repr(float(v)) for v in row))
    return "\n".join(lines) + "\n"


def _channel(path: Path, idx: int, entry: Any) -> Channel:
    where = f"channels[{idx}]"
    fields = _mapping(path, where, entry, _CHANNEL_KEYS, ("name", "unit", "kind"))
    sd = None if fields.get("sd") is None else _number(path, f"{where}.sd", fields["sd"])
    if sd is not None and not sd > 0.0:
        raise ValueError(f"{path}: {where}.sd must be above 0, got {sd:g}; leave it out if unknown")
    return Channel(str(fields["name"]), str(fields["unit"]), str(fields["kind"]), sd)


def _run(
    path: Path, idx: int, entry: Any, channels: tuple[Channel, ...], commands: list[str]
) -> Run:
    where = f"runs[{idx}]"
    fields = _mapping(path, where, entry, _RUN_KEYS, ("name", "file", "group"))
    order = fields.get("order", idx)
    if not isinstance(order, int) or isinstance(order, bool):
        raise ValueError(f"{path}: {where}.order must be a whole number, got {order!r}")
    setup = _mapping(path, f"{where}.setup", fields.get("setup") or {}, None, ())
    names = [c.name for c in channels]
    table = _read_run(path.parent / str(fields["file"]), names + commands)
    return Run(
        name=str(fields["name"]),
        time_s=table[:, 0],
        measured=table[:, 1 : 1 + len(names)],
        command={name: table[:, 1 + len(names) + i] for i, name in enumerate(commands)},
        group=str(fields["group"]),
        order=order,
        use=require_choice(f"{path}: {where}.use", fields.get("use", "fit"), USES),
        setup={k: _number(path, f"{where}.setup.{k}", v) for k, v in setup.items()},
    )


def _read_run(path: Path, columns: list[str]) -> np.ndarray:
    """(num_samples, 1 + num_columns): time and these columns."""
    samples: list[list[float]] = []
    with open_table(path, "run") as (header, rows):
        time = time_column(path, header)
        for name in columns:
            if name not in header:
                raise ValueError(
                    f"{path}: column {name} is missing{did_you_mean(name, header)}; "
                    f"the file has {', '.join(header)}"
                )
        where = [header.index(name) for name in columns]
        for line, row in rows:
            now = parse_time(path, line, "time_s", row[time], samples[-1][0] if samples else None)
            samples.append([now, *(parse_number(path, line, header[i], row[i]) for i in where)])
    if not samples:
        raise ValueError(f"{path}: no rows below the header; was the export cut short?")
    return np.array(samples)


def _system(path: Path, study: Mapping[str, Any]) -> str:
    """The system that ``model`` describes; else the one that ``system`` names."""
    model = study.get("model")
    if model is None:
        if study.get("system") is None:
            raise ValueError(f"{path}: the study has neither model nor system; describe its model")
        return require_choice(f"{path}: system", study["system"], SYSTEMS)
    fields = _mapping(path, "model", model, None, ("system",))
    return str(fields["system"])


def _mapping(
    path: Path, where: str, value: Any, known: tuple[str, ...] | None, needed: tuple[str, ...]
) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{path}: {where} must be a mapping, got {type(value).__name__}")
    for key in value if known is not None else ():
        require_choice(f"{path}: key of {where}", str(key), known or ())
    if missing := [key for key in needed if value.get(key) is None]:
        raise ValueError(f"{path}: {where} has no {missing[0]}; it needs {', '.join(needed)}")
    return value


def _list(path: Path, key: str, study: Mapping[str, Any]) -> list[Any]:
    value = study.get(key)
    value = [] if value is None else value
    if not isinstance(value, list):
        raise ValueError(f"{path}: {key} must be a list, got {type(value).__name__}")
    return value


def _number(path: Path, where: str, value: Any) -> float:
    if isinstance(value, str):
        try:
            value = float(value)  # YAML 1.1 reads 3e-6 (without a point) as text
        except ValueError:
            raise ValueError(f"{path}: {where} must be a number, got {value!r}") from None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{path}: {where} must be a finite number, got {value!r}")
    return float(value)
