"""What a search has computed, on disk after every flow: an interrupted one goes on from it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from diffsim.core.files import write_json_atomic


class Log:
    """Lists of entries by name, kept in a JSON file.

    Args:
        path: The file; None keeps nothing.
        settings: What the entries depend on.

    Raises:
        ValueError: the file holds entries of other settings.
    """

    def __init__(self, path: str | Path | None, settings: dict[str, Any]):
        self.path, self.settings = None if path is None else Path(path), settings
        self._lists: dict[str, list[dict[str, Any]]] = {}
        if self.path is None or not self.path.exists():
            return
        kept = json.loads(self.path.read_text(encoding="utf-8"))
        if kept.pop("settings", None) != settings:
            raise ValueError(
                f"{path} belongs to another run, not one of {settings}; delete it, or choose "
                "another path"
            )
        self._lists = kept

    def __getitem__(self, name: str) -> list[dict[str, Any]]:
        return self._lists.setdefault(name, [])

    def append(self, name: str, entry: dict[str, Any]) -> None:
        """Add an entry and save."""
        self[name].append(entry)
        if self.path is not None:
            write_json_atomic(self.path, {"settings": self.settings, **self._lists})
