"""Stages of a long run: each result is kept on disk, an interrupted run takes up where it was."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from diffsim.core.files import digest_of, read_kept, to_plain, write_json_atomic

Result = dict[str, Any]


class Stages:
    """Runs named stages once; with ``resume``, finished ones are read back.

    A stage is reused only if everything it depends on is unchanged: the settings given here and
    the results of all earlier stages.

    Args:
        folder: Results are kept in ``folder/stages``.
        settings: Settings that all stages depend on, such as data checksum, version and options.
        resume: Read finished stages back; otherwise compute everything anew.
    """

    def __init__(self, folder: Path, settings: Result, *, resume: bool):
        self.folder, self.resume = folder / "stages", resume
        self.reused: list[str] = []
        self._key = digest_of(settings)

    def run(
        self,
        name: str,
        compute: Callable[[], Result],
        *,
        valid: Callable[[Result], bool] = lambda result: True,
        **inputs: Any,
    ) -> Result:
        """The result of a stage: read back if it is finished, else computed and kept.

        Args:
            name: Name of the stage and of its file.
            compute: Function that computes the result.
            valid: Whether a kept result can still be used (files it names exist, say).
            **inputs: Inputs that this stage depends on beyond the settings and the stages before.
        """
        path = self.folder / f"{name}.json"
        self._key = digest_of({"before": self._key, "name": name, "inputs": inputs})
        kept = read_kept(path) if self.resume else None
        if kept is not None and kept.get("key") == self._key and valid(kept["result"]):
            self.reused.append(name)
            return kept["result"]
        result = to_plain(compute())
        write_json_atomic(path, {"key": self._key, "result": result})
        return result
