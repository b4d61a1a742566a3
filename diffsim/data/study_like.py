"""A study that is like another one, or like a rig that is ready: ``like:`` of study.yaml.

What the study states goes before. Mappings are joined key by key; entries of lists that have names
are joined by them, others, and ``runs``, are put in their place as a whole. ``null`` takes a key
away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diffsim.core.check import did_you_mean
from diffsim.core.inside import inside
from diffsim.core.yaml_text import read_yaml_file

READY = Path(__file__).parent / "ready"  # rigs by the names of their files


def ready_rigs() -> tuple[str, ...]:
    """Names of the rigs that are ready."""
    return tuple(sorted(file.stem for file in READY.glob("*.yaml")))


def read_whole(path: Path) -> Any:
    """Content of a study file, joined with that of the one it is like.

    Args:
        path: The file.

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
        own: What goes before.
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
