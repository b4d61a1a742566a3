"""Datasets of LeRobot (v2 and v3): ``meta/info.json`` names what is in the lists of the tables.

Episodes are files (v2) or values of ``episode_index`` (v3); ``action`` is what was commanded.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

STAMPS = "timestamp"  # seconds since the episode began
COUNTERS = ("frame_index", "index")  # of an episode, and of the dataset
_TABLES = "data/*/*.parquet"
_MOST_BYTES = 10_000_000


@dataclass(frozen=True)
class Info:
    """What a dataset says of its tables."""

    fps: float | None  # rows per second; None: not said
    names: Mapping[str, tuple[str, ...]]  # what the entries of a list column are, by column


def tables_of(folder: Path) -> list[Path]:
    """Tables of a dataset by its folder; none where it is no dataset."""
    return sorted(folder.glob(_TABLES)) if _read(folder) is not None else []


def info_of(table: Path) -> Info | None:
    """What the dataset that a table belongs to says of it; None where it belongs to none."""
    content = _read(table.parent.parent.parent) if table.match(_TABLES) else None
    if content is None:
        return None
    names = {
        column: listed
        for column, feature in content["features"].items()
        if isinstance(feature, dict) and (listed := _list_names(feature.get("names")))
    }
    fps = content.get("fps")
    return Info(float(fps) if isinstance(fps, (int, float)) and fps > 0 else None, names)


def _read(folder: Path) -> dict[str, Any] | None:
    path = folder / "meta" / "info.json"
    if not path.is_file() or path.stat().st_size > _MOST_BYTES:
        return None
    try:
        content = json.loads(path.read_text("utf-8"))
    except (ValueError, RecursionError):
        return None
    is_dataset = isinstance(content, dict) and isinstance(content.get("features"), dict)
    return content if is_dataset else None


def _list_names(names: Any) -> tuple[str, ...]:
    """Names in order: a list of them, or such a list under a heading, as v2 has ``motors``."""
    if isinstance(names, dict) and len(names) == 1:
        (names,) = names.values()
    if isinstance(names, list) and all(isinstance(n, str) for n in names):
        return tuple(names) if len(set(names)) == len(names) else ()
    return ()
