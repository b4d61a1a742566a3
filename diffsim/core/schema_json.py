"""JSON Schema of the blocks of users' files, for editors that complete keys and mark mistakes."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from diffsim.core.schema import Part
from diffsim.core.schema_keys import blocks_of, keys_of

Schema = dict[str, Any]
_SCALAR = ["number", "string", "boolean", "null"]


def definitions(part: type[Part]) -> dict[str, Schema]:
    """A block and all blocks within it by name, as ``$defs`` of a schema.

    What a key's own reader takes in short (a number with its unit as text, a name in place of a
    block) is allowed everywhere: the schema knows names and shapes, ``check`` knows values.

    Args:
        part: The outermost block.
    """
    return {name_of(block): _block(block) for block in blocks_of(part)}


def name_of(part: type[Part]) -> str:
    """Name of a block in ``$defs``: with its module, since two systems may have a ``Camera``."""
    return f"{part.__module__}.{part.__name__}"


def _block(part: type[Part]) -> Schema:
    keys = keys_of(part)
    properties = {}
    for key, info in zip(keys, part.model_fields.values(), strict=True):
        allowed = _loose(_type(info.annotation))
        words = key.kind if key.default in (None, "-") else f"{key.kind}; default {key.default}"
        properties[key.name] = {**allowed, "description": f"{key.meaning} ({words})"}
    schema: Schema = {"type": "object", "properties": properties, "additionalProperties": False}
    needed = [key.name for key in keys if key.default is None]
    return schema | ({"required": needed} if needed else {})


def _loose(schema: Schema) -> Schema:
    """A shape, or what stands for it in short: one entry for a list of them, text for a block."""
    if not schema or "enum" in schema or "anyOf" in schema:
        return schema
    if schema.get("type") == "array":
        entry = schema["items"]
        return {"anyOf": [schema, entry, {"type": _SCALAR}]} if entry else {}
    return {"anyOf": [schema, {"type": [*_SCALAR, "array"]}]}


def _type(annotation: Any) -> Schema:
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(inner[0])
    if origin in (Union, types.UnionType):
        return _union([_type(a) for a in inner if a is not type(None)])
    if origin is Literal:
        return {"enum": list(inner)}
    if origin in (tuple, list, Sequence):
        entry = _type(inner[0])
        if "$ref" in entry:  # a name in place of a block
            return {"type": "array", "items": {"anyOf": [entry, {"type": _SCALAR}]}}
        return {"type": "array", "items": _loose(entry)}
    if origin in (dict, Mapping):
        return {"type": "object", "additionalProperties": _loose(_type(inner[1]))}
    if isinstance(annotation, type) and issubclass(annotation, Part):
        return {"$ref": f"#/$defs/{name_of(annotation)}"}
    return {}


def _union(choices: list[Schema]) -> Schema:
    kept = [choice for choice in choices if choice]
    if len(kept) < len(choices) or not kept:
        return {}  # one of them may be anything
    return kept[0] if len(kept) == 1 else {"anyOf": [*kept, {"type": [*_SCALAR, "array"]}]}
