"""The one reader of YAML: plain values only, bounded, nothing dropped, errors with file and line.

A text of 300 bytes can name a list of lists of lists by aliases that would take years to walk
through. Here aliases count as what they stand for, and nesting has an end.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

MAX_BYTES = 20_000_000
MAX_LETTERS = 5_000_000  # 4 CPU s, where all is short words
MAX_NODES = 200_000  # 3 CPU s; keys, values and lists, aliases counted as what they stand for
MAX_DEPTH = 50  # lists and mappings inside of each other


class _RefusalError(yaml.MarkedYAMLError):
    """What would be YAML, but is refused here."""


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with bounds; a key that stands twice is an error."""

    def __init__(self, text: str):
        super().__init__(text)
        self._depth, self._count = 0, 0
        self._sizes: dict[str, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, yaml.ScalarEvent) and event.style == '"':  # it alone has escapes
            try:  # halves of a pair, as JSON writes it, are one character
                halves = event.value.encode("utf-16", "surrogatepass")
                event.value = halves.decode("utf-16")
            except UnicodeDecodeError:
                raise self._refuse_event(event, "half of a character, such as \\ud800") from None
        if isinstance(event, yaml.AliasEvent):
            if event.anchor in self.anchors and event.anchor not in self._sizes:
                raise self._refuse_event(event, f"alias {event.anchor!r} stands inside of itself")
            self._add(self._sizes.get(event.anchor, 0), event)
            return super().compose_node(parent, index)
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise self._refuse_event(event, f"more than {MAX_DEPTH} levels inside of each other")
        before = self._count
        self._add(1, event)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if event.anchor is not None:
            self._sizes[event.anchor] = self._count - before
        return node

    def compose_mapping_node(self, anchor: Any) -> Any:
        node = super().compose_mapping_node(anchor)
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _RefusalError(None, None, "a key must be plain text", key.start_mark)
            if key.value in seen and key.value != "<<":
                raise _RefusalError(None, None, f"key {key.value!r} stands twice", key.start_mark)
            seen.add(key.value)
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, LookupError) as error:  # dates, numbers, encodings
            kind = node.tag.rpartition(":")[2]
            raise _RefusalError(None, None, f"no {kind}: {error}", node.start_mark) from error

    def _add(self, count: int, event: Any) -> None:
        self._count += count
        if self._count > MAX_NODES:
            raise self._refuse_event(event, f"more than {MAX_NODES:,} values, aliases counted")

    def _refuse_event(self, event: Any, why: str) -> _RefusalError:
        return _RefusalError(None, None, why, event.start_mark)


def load_yaml(text: str, source: str | Path) -> Any:
    """Plain values of a YAML text: dicts, lists, text, numbers, truth values, dates.

    Args:
        source: What error messages call it, such as its path.

    Raises:
        ValueError: not YAML; a key that stands twice; too large, too deep, or aliases that stand
            for too much; with source and line.
    """
    node = compose_yaml(text, source)
    return None if node is None else construct(node, source)


def read_yaml_file(path: str | Path) -> Any:
    """``load_yaml`` of a file of UTF-8 text.

    Raises:
        FileNotFoundError: no such file.
        ValueError: as ``load_yaml``; or the file is no text.
    """
    return load_yaml(read_text(path), path)


def read_text(path: str | Path, max_bytes: int = MAX_BYTES) -> str:
    """Text of a file, UTF-8.

    Raises:
        FileNotFoundError: no such file, or no ordinary one.
        ValueError: too large, or not UTF-8.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if (size := path.stat().st_size) > max_bytes:
        raise ValueError(f"{path}: must have at most {max_bytes:,} bytes, got {size:,}")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        line = path.read_bytes()[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: not UTF-8 text; save it as UTF-8") from None


def compose_yaml(text: str, source: str | Path) -> yaml.Node | None:
    """The tree of nodes with their lines, bounded as in ``load_yaml``; None of an empty text."""
    if len(text) > MAX_LETTERS:
        raise ValueError(f"{source}: must have at most {MAX_LETTERS:,} letters, got {len(text):,}")
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_node()
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        raise _locate_error(error, text, source) from None


def construct(node: yaml.Node, source: str | Path) -> Any:
    """Plain value of a node of ``compose_yaml``."""
    try:
        return _Loader("").construct_document(node)
    except yaml.YAMLError as error:
        raise _locate_error(error, "", source) from None


def _locate_error(error: yaml.YAMLError, text: str, source: str | Path) -> ValueError:
    """The error with file and line; the text itself is not shown, it may be of another file."""
    if isinstance(error, yaml.MarkedYAMLError):
        mark = error.problem_mark or error.context_mark
        line = 1 if mark is None else mark.line + 1
        why = error.problem or error.context or "it cannot be read"
        what = why if isinstance(error, _RefusalError) else f"not YAML: {why}"
        return ValueError(f"{source}, line {line}: {what}")
    position = getattr(error, "position", 0)
    line = text[:position].count("\n") + 1
    character = getattr(error, "character", 0)
    return ValueError(f"{source}, line {line}: not YAML: character {character:#x} is not allowed")
