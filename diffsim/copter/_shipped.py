"""YAML files that come with the package, found by name, or a user's own, by path."""

from __future__ import annotations

import os
from importlib import resources
from pathlib import Path

from diffsim.core.check import require_choice
from diffsim.core.inside import inside
from diffsim.core.yaml_text import read_text


def shipped(folder: str) -> tuple[str, ...]:
    """Names of the files in a folder of ``diffsim.copter``, such as "design/designs"."""
    entries = resources.files("diffsim.copter").joinpath(folder).iterdir()
    return tuple(sorted(Path(e.name).stem for e in entries if e.name.endswith(".yaml")))


def read_shipped(folder: str, kind: str, name: str) -> str:
    """Text of a shipped file.

    Raises:
        ValueError: no such ``kind``; the message offers the closest names.
    """
    require_choice(kind, name, shipped(folder))
    entry = resources.files("diffsim.copter").joinpath(folder, f"{name}.yaml")
    return entry.read_text(encoding="utf-8")


def beside_or_shipped(folder: Path, stated: str, what: str) -> str | Path:
    """A file that another file names, in its folder, or the name of a shipped one.

    Args:
        folder: Folder that a path cannot leave.
        stated: What the other file states.
        what: What states it, for messages.

    Returns:
        A path, or a name, as ``read_named`` takes it.

    Raises:
        ValueError: the path leaves the folder.
    """
    path = inside(folder, stated, what)
    is_name = Path(stated).suffix == "" and path.parent == folder and not path.is_file()
    return stated if is_name else path


def read_named(folder: str, kind: str, name: str | Path) -> tuple[str, str, Path | None]:
    """Text of a shipped file or of the one at a path; what to call it; the folder of the latter.

    Raises:
        FileNotFoundError: a path without a file.
        ValueError: unknown name.
    """
    if isinstance(name, str) and Path(name).suffix == "" and os.sep not in name:
        return read_shipped(folder, kind, name), f"{name}.yaml", None
    path = Path(name)
    if not path.is_file():
        raise FileNotFoundError(
            f"no {kind} file {path}; the shipped ones are {', '.join(shipped(folder))}"
        )
    return read_text(path), str(path), path.parent
