"""Studies written as files: ``study.yaml`` and one tidy CSV per run, all in SI units."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from diffsim.core.checked import checked
from diffsim.core.files import csv_text, to_plain, write_text_atomic
from diffsim.data.study import Channel, Command, Run, Study
from diffsim.data.study_file import STUDY_FILE

_FILE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")


@checked
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
            write_text_atomic(new / f"{run.name}.csv", _format_run(run, study, commands))
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


_CHANNEL_KEYS = (
    "sd",
    "shown_unit",
    "sensor",
    "shown_formula",
    "lower",
    "upper",
)  # where they are stated


def _to_yaml(study: Study, commands: list[str]) -> dict[str, Any]:
    known = {c.name: c for c in study.commands}
    described = study.model is not None
    return {
        "name": study.name,
        **({"model": to_plain(dict(study.model or {}))} if described else {"system": study.system}),
        **({"model_folder": str(study.folder.resolve())} if described and study.folder else {}),
        "channels": [
            _collect_given(c, *_CHANNEL_KEYS, name=c.name, unit=c.unit, kind=c.kind)
            for c in study.channels
        ],
        "commands": [_command(known[name]) if name in known else name for name in commands],
        "runs": [
            {"name": r.name, "file": f"{r.name}.csv", "group": r.group, "order": r.order}
            | {"use": r.use, "setup": {k: _fact(v) for k, v in r.setup.items()}}
            | ({} if r.row_s is None else {"row_s": float(r.row_s)})
            for r in study.runs
        ],
        "metadata": to_plain(dict(study.metadata)),
        **({"allows": to_plain(dict(study.allows))} if study.allows else {}),
        **({"export": to_plain(dict(study.export))} if study.export else {}),
        **({"todo": list(study.todo)} if study.todo else {}),
    }


def _command(command: Command) -> dict[str, Any]:
    keys = ("unit", "lower", "upper", "rate", "shown_unit", "before")
    measured = {"is_measured": True} if command.is_measured else {}
    return _collect_given(command, *keys, name=command.name) | measured


def _collect_given(of: Channel | Command, *keys: str, **first: Any) -> dict[str, Any]:
    """Attributes that are not None, after what comes first."""
    more = {key: to_plain(getattr(of, key)) for key in keys if getattr(of, key) is not None}
    return first | more


def _fact(value: Any) -> float | str:
    return value if isinstance(value, str) else float(value)


def _format_run(run: Run, study: Study, commands: list[str]) -> str:
    missing = np.full(len(run.time_s), np.nan)
    columns = [run.time_s, *run.measured.T, *(run.command.get(c, missing) for c in commands)]
    columns += [run.columns.get(c.name, missing) for c in study.columns]
    beside = [f"{c.name} ({c.unit})" if c.unit else c.name for c in study.columns]
    header = ["time_s", *(c.name for c in study.channels), *commands, *beside]
    return csv_text(header, (map(float, row) for row in zip(*columns, strict=True)))
