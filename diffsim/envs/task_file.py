"""Tasks as YAML files: ``task: NAME`` and its options, files that it names relative to it.

::

    task: CopterHover
    vehicle: my_quad.yaml
    seconds: 4

The file is read as a study is: plain values, bounded, and what it names stays in its folder.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffsim.core.files import to_plain
from diffsim.core.inside import inside
from diffsim.core.yaml_text import read_yaml_file

SUFFIXES = (".yaml", ".yml")
_MOST = 4  # differences that are told; more of them say no more


class ChangedTaskError(ValueError):
    """A task file is no longer what a controller was trained on."""


@dataclass(frozen=True)
class TaskFile:
    """Content of a task file."""

    path: Path
    task: str  # name of the kind of task
    options: Mapping[str, Any]  # all other keys

    def record(self) -> dict[str, Any]:
        """What a controller remembers of the file: its keys, and digests of the files it names."""
        digests = {
            name: hashlib.sha256(path.read_bytes()).hexdigest()
            for name, path in sorted(set(self._list_files(self.options)))
        }
        return {"keys": to_plain({"task": self.task, **self.options}), "files": digests}

    def differences(self, record: Mapping[str, Any]) -> list[str]:
        """What differs from what ``record`` gave once, a line each.

        Args:
            record: As ``record`` made it, perhaps from JSON.
        """
        now, out = self.record(), []
        then, have = (dict(_list_leaves(r["keys"])) for r in (record, now))
        for key in dict.fromkeys([*then, *have]):
            before, after = (repr(d[key]) if key in d else "absent" for d in (then, have))
            if before != after:
                out.append(f"{key} was {before}, is {after}")
        for name in dict.fromkeys([*record["files"], *now["files"]]):
            if record["files"].get(name) != now["files"].get(name):
                out.append(f"the file {name} has changed")
        return out

    def _list_files(self, value: Any) -> Iterator[tuple[str, Path]]:
        """Files below the folder that the keys name, by name."""
        if isinstance(value, Mapping):
            for one in value.values():
                yield from self._list_files(one)
        elif isinstance(value, (list, tuple)):
            for one in value:
                yield from self._list_files(one)
        elif isinstance(value, str) and 0 < len(value) < 4096:
            try:
                path = inside(self.path.parent, value, "file")
                if path.is_file():
                    yield value, path
            except (ValueError, OSError):  # text that is no path
                return


def is_task_file(name: str | Path) -> bool:
    """Whether a task is named by its file, not by its name."""
    return isinstance(name, Path) or name.endswith(SUFFIXES)


def task_label(name: str | Path) -> str:
    """What folders and figures call a task: its name, or that of its file."""
    return Path(name).stem if is_task_file(name) else str(name)


def read_task_file(path: str | Path) -> TaskFile:
    """Read a task file; its keys are checked when the task is made.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not YAML, no mapping, or without ``task``.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such task file; give the path of a YAML file, relative to {Path.cwd()}"
        )
    content = read_yaml_file(path)
    if not isinstance(content, Mapping):
        raise ValueError(
            f"{path}: must be a mapping with `task: NAME` and its options, got "
            f"{type(content).__name__}"
        )
    if not isinstance(content.get("task"), str):
        raise ValueError(
            f"{path}: task must name a kind of task, such as SoftBody or CopterHover, got "
            f"{content.get('task')!r}"
        )
    for key in content:
        if not isinstance(key, str):
            raise ValueError(f"{path}: keys must be text, got {key!r}")
    options = {key: value for key, value in content.items() if key != "task"}
    return TaskFile(path, content["task"], options)


def require_unchanged(name: str | Path, record: Mapping[str, Any] | None, what: str) -> None:
    """Refuse a task file that is no longer what it was.

    Args:
        record: Of the file, as it was then; None: it was none, or nobody kept it.
        what: What belongs to the file as it was, such as "runs/eel/checkpoint.pt".

    Raises:
        ChangedTaskError: it is no longer the same; the message says in what.
    """
    if record is None or not is_task_file(name):
        return
    changed = read_task_file(name).differences(record)
    if changed:
        more = [f"and {len(changed) - _MOST} more"] if len(changed) > _MOST else []
        raise ChangedTaskError(
            f"{name}: has changed since {what} was trained on it: "
            f"{'; '.join([*changed[:_MOST], *more])}; restore it, or train anew"
        )


def record_of(name: str | Path) -> dict[str, Any] | None:
    """``TaskFile.record`` of a task's file; None of a task that has a name."""
    return read_task_file(name).record() if is_task_file(name) else None


def _list_leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves by their path, such as "model.material.density"."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _list_leaves(one, f"{path}.{key}" if path else str(key))
    elif isinstance(value, (list, tuple)):
        for k, one in enumerate(value):
            yield from _list_leaves(one, f"{path}[{k}]")
    else:
        yield path, value
