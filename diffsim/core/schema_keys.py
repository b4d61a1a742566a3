"""Keys of the blocks of users' files, in plain words: for reference pages and first files."""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from diffsim.core.schema import KindWords, Part
from diffsim.core.schema_paths import PathWords

_PLAIN = {float: "number", int: "whole number", str: "text", bool: "true or false", Any: "anything"}


@dataclass(frozen=True)
class Key:
    """A key of a block."""

    name: str  # key as it is written in the file
    kind: str  # what may stand there, in words
    default: str | None  # what holds where it is left out; None: it must be given
    meaning: str  # what the key says, in a sentence
    parts: tuple[type[Part], ...]  # blocks that its value is made of
    reach: str | None = None  # of a path, where it may lie; None: it names no file


def keys_of(part: type[Part]) -> list[Key]:
    """Keys of a block in the order of its class."""
    return [_key(name, info) for name, info in part.model_fields.items()]


def blocks_of(part: type[Part]) -> list[type[Part]]:
    """A block and all blocks within it, each once, outer ones first."""
    found: dict[type[Part], None] = {part: None}
    for key in keys_of(part):
        for inner in key.parts:
            for block in blocks_of(inner) if inner not in found else ():
                found.setdefault(block)
    return list(found)


def _key(name: str, info: FieldInfo) -> Key:
    said = next((m.words for m in info.metadata if isinstance(m, KindWords)), None)
    words = said or words_of(info.annotation)
    return Key(
        info.alias or name,
        words,
        _default(info),
        " ".join((info.description or "").split()),
        tuple(dict.fromkeys(_parts(info.annotation))),
        next((m.reach for m in _words(info) if isinstance(m, PathWords)), None),
    )


def _words(info: FieldInfo) -> Iterator[Any]:
    """What annotates a key, within unions and lists too."""
    yield from info.metadata
    waiting = [info.annotation]
    while waiting:
        one = waiting.pop()
        yield from getattr(one, "__metadata__", ())
        waiting += get_args(one)


def words_of(annotation: Any) -> str:
    """A type in words: ``tuple[float, ...]`` is "list of number"."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        said = next((m.words for m in inner[1:] if isinstance(m, KindWords)), None)
        return said or words_of(inner[0])
    if origin in (Union, types.UnionType):
        kept = dict.fromkeys(words_of(a) for a in inner if a is not type(None))
        return " or ".join(kept)
    if origin is Literal:
        return ", ".join(map(str, inner)) if len(inner) > 1 else f"`{inner[0]}`"
    if origin in (tuple, list, Sequence):
        if (len(inner) == 2 and inner[1] is Ellipsis) or origin is not tuple:
            return f"list of {words_of(inner[0])}"
        return f"list of {len(inner)}: {', '.join(dict.fromkeys(map(words_of, inner)))}"
    if origin in (dict, Mapping):
        return f"mapping of names to {words_of(inner[1])}"
    if annotation in _PLAIN:
        return _PLAIN[annotation]
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return annotation.__name__
    return "mapping" if annotation is dict else str(getattr(annotation, "__name__", "anything"))


def _parts(annotation: Any) -> Iterator[type[Part]]:
    if isinstance(annotation, type) and issubclass(annotation, Part):
        yield annotation
    for inner in get_args(annotation):
        yield from _parts(inner)


def _default(info: FieldInfo) -> str | None:
    if info.is_required():
        return None
    value = info.get_default(call_default_factory=True)
    if value is None or value in ((), {}, "") or isinstance(value, Part):
        return "-"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (tuple, list)):
        return ", ".join(map(str, value))
    return str(value)
