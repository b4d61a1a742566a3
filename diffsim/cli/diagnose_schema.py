"""``diffsim diagnose schema``: JSON Schema of study.yaml, for editors."""

from __future__ import annotations

import json
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from diffsim.core.files import write_text_atomic
from diffsim.core.schema import Part
from diffsim.core.schema_keys import blocks_of, keys_of
from diffsim.core.version import __version__
from diffsim.data.study_schema import StudyFile
from diffsim.systems.registry import description_class, known_systems

LIKE = "_like"  # of definitions that another study completes


def study_schema() -> dict[str, Any]:
    """Schema of a study: its keys, and those of ``model`` by the kind of system."""
    defs = definitions(StudyFile)
    cases = []
    for system in sorted(known_systems()):
        try:
            description = description_class(system)
        except ImportError:  # of an extra that is not installed: its keys are not known here
            continue
        defs |= definitions(description)
        cases.append(
            {
                "if": {"properties": {"system": {"const": system}}, "required": ["system"]},
                "then": {"$ref": f"#/$defs/{name_of(description)}"},
            }
        )
    defs[name_of(StudyFile)]["properties"]["model"] = {
        "type": "object",
        "properties": {"system": {"enum": sorted(known_systems())}},
        "required": ["system"],
        "allOf": cases,
        "description": "Description of the system that was recorded",
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"study.yaml of diffsim {__version__}",
        "if": {"required": ["like"]},
        "then": {"$ref": f"#/$defs/{name_of(StudyFile)}{LIKE}"},
        "else": {"$ref": f"#/$defs/{name_of(StudyFile)}"},
        "$defs": defs | {name + LIKE: _lacking(one) for name, one in defs.items()},
    }


def _lacking(schema: Any) -> Any:
    """The same schema of a study that is like another one, which has what this one lacks."""
    if isinstance(schema, list):
        return [_lacking(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        key: part if key == "if" else f"{part}{LIKE}" if key == "$ref" else _lacking(part)
        for key, part in schema.items()
        if not (key == "required" and isinstance(part, list))
    }


def write_schema(out: Path) -> None:
    """Write the schema, and say the line that editors look for."""
    write_text_atomic(out, json.dumps(study_schema(), indent=1, ensure_ascii=False) + "\n")
    print(f"wrote {out}; the first line of a study then names it for editors:")
    print(f"# yaml-language-server: $schema={out}")


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
