"""YAML with line numbers, so that an error can say where."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import yaml

from diffsim.core.check import require_choice, require_number
from diffsim.core.yaml_text import compose_yaml, construct

Path = tuple[str | int, ...]


@dataclass
class Located:
    """Plain values of a YAML document and the line of each key.

    Attributes:
        value: dicts, lists, numbers, strings.
        lines: Path of keys to line, counted from 1.
        source: File name for messages.
    """

    value: Any
    source: str
    lines: dict[Path, int] = field(default_factory=dict)

    def error(self, path: Path, message: str) -> ValueError:
        """A ValueError that names file, line and key."""
        line = next(
            (self.lines[path[:k]] for k in range(len(path), -1, -1) if path[:k] in self.lines), 1
        )
        where = ".".join(map(str, path))
        return ValueError(f"{self.source}, line {line}{': ' + where if where else ''}: {message}")

    def require_choice(self, path: Path, name: str, value: str, choices: Iterable[str]) -> str:
        """``require_choice`` that names file, line and key."""
        try:
            return require_choice(name, value, choices)
        except ValueError as error:
            raise self.error(path, str(error)) from error

    def require_number(self, path: Path, value: Any) -> float:
        """``require_number`` that names file, line and key."""
        try:
            return require_number("value", value)
        except (ValueError, TypeError) as error:
            raise self.error(path, str(error)) from error


def read_yaml(text: str, source: str) -> Located:
    """Parse YAML; duplicate keys are errors, as they would silently drop something.

    Raises:
        ValueError: as ``core.yaml_text.load_yaml``; with the line.
    """
    root = compose_yaml(text, source)
    located = Located(None, source)
    if root is not None:
        located.value = _plain(root, (), located)
    return located


def _plain(node: yaml.Node, path: Path, located: Located) -> Any:
    located.lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key = str(key_node.value)
            located.lines[(*path, key)] = key_node.start_mark.line + 1
            result[key] = _plain(value_node, (*path, key), located)
        return result
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, (*path, k), located) for k, item in enumerate(node.value)]
    return construct(node, located.source)
